"""Code shared by the applications of ``serve`` and ``view``: access, errors, the log, reading requests, and the API description."""

from __future__ import annotations

import asyncio
import contextlib
import hmac
import ipaddress
import json
import logging
import re
import time
import uuid
from collections.abc import Callable, Mapping
from importlib.metadata import version
from importlib.resources import files
from pathlib import PurePosixPath
from typing import Any
from urllib.parse import urlsplit

import jinja2
from fastapi import FastAPI, Request
from starlette.datastructures import MutableHeaders, UploadFile
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, HTTPConnection
from starlette.responses import HTMLResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from bidnerf.service.models import (
    LONGEST_NAME,
    ErrorBody,
    PhotoForm,
    Refused,
    Upload,
    abbreviate,
    validate,
)
from bidnerf.service.settings import MEBIBYTE, ServiceLimits
from bidnerf_core.errors import InputError

service_log = logging.getLogger("bidnerf.service")

SAFE = {
    "X-Content-Type-Options": "nosniff",
    "Content-Security-Policy": "default-src 'none'; frame-ancestors 'none'",
    "Cache-Control": "no-store",
}
"""Headers added to responses that do not set them: browsers must not treat text in a response as a page or a script."""
PROBLEM = "application/problem+json"
CLIENT_GONE = 499
"""The status in the log and the metrics for a client that disconnected before the response; nobody receives it."""
ERRORS = {
    400: ("Bad request", "The request is malformed: the detail states what was found and what is expected."),
    401: ("No valid token", "The request does not carry the token of the service."),
    403: ("Not allowed", "Without a token, only programs on the service's own machine may send requests."),
    404: ("Not found", "There is no such thing."),
    405: ("Method not allowed", "The path lacks this method."),
    408: ("Upload too slow", "The request did not arrive in time."),
    413: ("Too large", "The request is too large."),
    422: (
        "Unprocessable content",
        "The photo cannot be read or localized at all, or what is known about it contradicts it.",
    ),
    429: ("Too many requests", "The service is full."),
    500: ("Internal error", "An error in the service itself, which its log describes."),
    503: ("Not available", "The service cannot answer at present."),
    504: ("Took too long", "The answer took too long."),
}
"""Titles and descriptions of errors, by HTTP status."""
FAILED = "the service failed; its log names the cause under the id {}"
"""The detail of an internal error, whose cause may name paths of this machine."""
FaultReport = Callable[[Scope, int, float, Exception | None], None]
"""A function that receives the scope, the status, the duration (seconds) and the internal error of each request."""


def report_fault(scope: Scope, status: int, seconds: float, error: Exception | None) -> None:
    """Log a request only if it ended with an internal error."""
    if error is not None:
        service_log.error("internal error while answering %s", scope["path"][:200], exc_info=error)


class Application(FastAPI):
    """A FastAPI application with access control (see ``refusal``), errors in the format of RFC 9457, and an OpenAPI description."""

    def __init__(
        self,
        title: str,
        token: str | None,
        cookie: str | None = None,
        report: FaultReport = report_fault,
        **more: Any,
    ) -> None:
        self.refused, self.lifespan = 401 if token is not None else 403, more["lifespan"]
        super().__init__(
            title=title,
            version=version("bidnerf"),
            openapi_url=None,
            docs_url=None,
            redoc_url=None,
            redirect_slashes=False,
            generate_unique_id_function=lambda route: "_".join(
                re.findall(r"\w+", f"{min(route.methods or ()).lower()} {route.path}")
            ),
            separate_input_output_schemas=False,
            responses=error_responses(self.refused, 500),
            **more,
        )
        self.add_middleware(Gate, token=token, cookie=cookie, report=report)
        for kind in (Refused, InputError, HTTPException):
            self.add_exception_handler(kind, _answer_error)

        @self.get("/openapi.json", summary="Get this description in the format of OpenAPI 3.1.")
        async def openapi() -> dict[str, Any]:
            return self.openapi()

        @self.get("/docs", summary="Get this description as a page.", response_class=HTMLResponse)
        async def docs() -> HTMLResponse:
            template = files(__package__).joinpath("docs.html").read_text(encoding="utf-8")
            page = jinja2.Environment(autoescape=True).from_string(template).render(api=self.openapi())
            policy = "default-src 'none'; style-src 'unsafe-inline'; frame-ancestors 'none'"
            return HTMLResponse(page, headers={"Content-Security-Policy": policy})

    def openapi(self) -> dict[str, Any]:
        """Return the OpenAPI description, without the validation errors that FastAPI declares but this application never returns."""
        if self.openapi_schema is not None:
            return self.openapi_schema
        api = super().openapi()
        schemas = api.setdefault("components", {}).setdefault("schemas", {})
        for unused in ("HTTPValidationError", "ValidationError"):
            schemas.pop(unused, None)
        schemas["Problem"] = ErrorBody.model_json_schema(ref_template="#/components/schemas/{model}")
        schemas |= schemas["Problem"].pop("$defs", {})
        for operation in (each for operations in api["paths"].values() for each in operations.values()):
            for body in operation.get("requestBody", {"content": {}})["content"].values():
                schemas |= body["schema"].pop("$defs", {})
            if "HTTPValidationError" in json.dumps(operation["responses"].get("422")):
                del operation["responses"]["422"]
        api["security"] = []
        if self.refused == 401:
            api["components"]["securitySchemes"] = {"token": {"type": "http", "scheme": "bearer"}}
            api["security"] = [{"token": []}]
            health = api["paths"][OPEN]["get"]
            health["security"] = []
            del health["responses"]["401"]
        return api


class Gate:
    """ASGI middleware that checks access to each request, sets headers on each response, and reports its status and duration.

    A HEAD request is answered as the GET request of the same path, whose body the server leaves out. If ``cookie`` names a
    cookie, a browser needs to send the token only once, in the address ``/?token=TOKEN``.
    """

    def __init__(self, app: ASGIApp, token: str | None, cookie: str | None, report: FaultReport) -> None:
        self.app, self.token, self.cookie, self.report = app, token, cookie, report

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "websocket":
            await send({"type": "websocket.close", "code": 1008})
            return
        if scope["type"] != "http":  # the startup and the shutdown
            await self.app(scope, receive, send)
            return
        began, status, fault = time.perf_counter(), 0, None
        number = uuid.uuid4().hex
        served = {**scope, "state": {**scope.get("state", {}), "id": number}}
        if scope["method"] == "HEAD":
            served["method"] = "GET"

        async def answer(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status, headers = message["status"], MutableHeaders(raw=list(message["headers"]))
                for name, value in SAFE.items():
                    headers.setdefault(name, value)
                headers["X-Request-Id"] = number
                message = {**message, "headers": headers.raw}
            await send(message)

        try:
            await self._admit(served)(served, receive, answer)
        except Exception as error:  # an internal error: the operator has to see where it happened
            fault = error
            if not status:
                await problem(500, FAILED.format(number))(served, receive, answer)
        except asyncio.CancelledError:  # the server stops, and nothing waits for the end of this task
            if not status:
                more = {"Retry-After": "5", "Connection": "close"}
                await problem(503, "the service is being stopped", more)(served, receive, answer)
        self.report({**served, "method": scope["method"]}, status, time.perf_counter() - began, fault)

    def _admit(self, scope: Scope) -> ASGIApp:
        """Return what answers a request: the application, a redirect that logs a browser in, or the reason for a refusal."""
        # The name contains the port, since cookies are sent to all ports of a host.
        cookie = None if self.cookie is None else f"{self.cookie}_{scope['server'][1]}"
        request = HTTPConnection(scope)
        token, given = self.token, request.query_params.get("token", "")
        brings_token = scope["path"] == "/" and hmac.compare_digest(given.encode(), (token or "").encode())
        if cookie is not None and token is not None and brings_token:
            secure = "https" in (scope["scheme"], request.headers.get("x-forwarded-proto"))
            page = RedirectResponse("/", 303, {"Referrer-Policy": "no-referrer"})
            page.set_cookie(cookie, token, httponly=True, samesite="strict", secure=secure)
            return page
        refused = refusal(scope, self.token, cookie)
        if refused is None:
            return self.app
        return problem(
            *refused, {"Connection": "close"} | ({"WWW-Authenticate": "Bearer"} if refused[0] == 401 else {})
        )


def problem(status: int, detail: str, headers: Mapping[str, str] | None = None, **more: Any) -> Response:
    """Return an error response in the format of RFC 9457."""
    body = {"title": ERRORS.get(status, ("Error",))[0], "status": status, "detail": detail, **more}
    return Response(json.dumps(body), status, headers, PROBLEM)


async def _answer_error(request: Request, error: Exception) -> Response:
    """Return the error response for a ``Refused``, ``InputError`` or ``HTTPException`` that a request raised."""
    if isinstance(error, Refused):
        return problem(error.status, error.detail, error.headers, **error.more)
    if isinstance(error, HTTPException):
        detail, headers = f"{error.detail}; /docs describes what this service answers", error.headers
        if error.status_code == 405:  # each method of a path has its own route, which knows no other method
            path = request.scope["route"].path
            same = (route for route in request.app.routes if route.path == path)
            allowed = ", ".join(sorted({method for route in same for method in route.methods}))
            detail, headers = f"{path} does not take {request.method}, expected {allowed}", {"Allow": allowed}
        return problem(error.status_code, detail, headers)
    return problem(400, str(error))


# Access.

OPEN = "/health"
"""The path that needs no token: load balancers poll it, and it reveals nothing about the maps."""


def refusal(scope: Scope, token: str | None, cookie: str | None = None) -> tuple[int, str] | None:
    """Return the status and the reason if a request is refused, or None if it may pass.

    A web page in a browser may send requests to any address. Such requests are detected by their ``Origin`` header,
    which differs from the address requested, or, if the name of another site resolves to this machine, by their
    ``Host`` header. ``cookie`` is the name of a cookie that may hold the token.
    """
    request = HTTPConnection(scope)
    host, origin = request.headers.get("host", ""), request.headers.get("origin")
    try:
        is_local = is_loopback(urlsplit(f"//{host}").hostname)
        is_own_page = origin is None or urlsplit(origin).netloc == host
    except ValueError:  # the headers hold no valid addresses
        is_local = is_own_page = False
    if token is not None:
        given = [(f"Bearer {token}", request.headers.get("authorization", ""))]
        if cookie is not None and is_own_page:
            given.append((token, request.cookies.get(cookie, "")))
        if scope["path"] == OPEN or any(hmac.compare_digest(a.encode(), b.encode()) for a, b in given):
            return None
        return 401, "expected the header 'Authorization: Bearer TOKEN' with the token of this service"
    if not is_local:
        return 403, "without a token the service answers requests to localhost only"
    return None if is_own_page else (403, "requests from pages of other sites are rejected")


def is_loopback(host: str | None) -> bool:
    """Return whether a host name or address is a loopback address."""
    with contextlib.suppress(ValueError):
        return ipaddress.ip_address(host or "").is_loopback
    return host == "localhost" or str(host).endswith(".localhost")


# Requests.


async def read_body(request: Request, limits: ServiceLimits) -> bytes:
    """Read the body of a request. Raises ``Refused`` if the body is too large or does not arrive in time."""
    close = {"Connection": "close"}  # the rest of the body is not read
    most = f"expected at most {limits.max_megabytes:g} MiB"
    text = request.headers.get("content-length", "0")
    try:
        announced = int(text)
    except ValueError as error:
        raise Refused(400, f"Content-Length is {abbreviate(text)}, expected a number", close) from error
    if announced > limits.max_bytes:
        raise Refused(413, f"the request has {announced / MEBIBYTE:,.0f} MiB, {most}", close)
    content = bytearray()
    try:
        async with asyncio.timeout(limits.upload_timeout):
            async for chunk in request.stream():
                content += chunk
                if len(content) > limits.max_bytes:
                    raise Refused(413, f"the request is too large, {most}", close)
    except TimeoutError as error:
        raise Refused(408, f"the request did not arrive within {limits.upload_timeout:g} s", close) from error
    except ClientDisconnect as error:
        raise Refused(CLIENT_GONE, "the client disconnected") from error
    return bytes(content)


async def read_photo(request: Request, limits: ServiceLimits) -> Upload:
    """Read a photo and its metadata from a form, or from the body and the query parameters of a request.

    Raises ``Refused`` in the same cases as ``read_body``, and ``InputError`` for missing or invalid fields.
    """
    content = await read_body(request, limits)
    kind, stem = request.headers.get("content-type", "").partition(";")[0].strip().lower(), ""
    items: list[tuple[str, Any]] = request.query_params.multi_items()
    items += await _read_form(request, content) if kind == "multipart/form-data" else [("photo", content)]
    values = dict[str, Any]()
    for name, value in items:
        if name in values:
            raise InputError(f"{name} is given twice", expected="once")
        if name == "photo" and isinstance(value, UploadFile):
            stem = PurePosixPath((value.filename or "").replace("\\", "/")).stem[:LONGEST_NAME]
        values[name] = await value.read() if isinstance(value, UploadFile) else value
    if not values.get("photo") and values.keys() <= PhotoForm.model_fields.keys():
        raise InputError("no photo", expected="its bytes as the body, or a form with a file 'photo'")
    if "depth_unit" in values and "depth" not in values:
        raise InputError("depth_unit was given without depth", expected="the depth image that it belongs to")
    parameters = validate(PhotoForm, values).model_dump(exclude_unset=True)
    sent: dict[str, bytes] = {name: parameters.pop(name) for name in ("photo", "depth") if name in parameters}
    # The stem of a file's name is text in the answer, never a file name; a given name takes precedence.
    return Upload(({"name": stem} if stem else {}) | parameters, sent)


async def _read_form(request: Request, content: bytes) -> list[tuple[str, str | UploadFile]]:
    """Return the fields of a form with the body ``content``. Raises ``InputError`` for a malformed form."""

    async def receive() -> Message:
        return {"type": "http.request", "body": content}

    most = len(PhotoForm.model_fields)
    try:
        form = await Request(request.scope, receive).form(max_files=most, max_fields=most, max_part_size=MEBIBYTE)
    except (HTTPException, KeyError, ValueError, LookupError) as error:
        reason = getattr(error, "detail", None) or "no boundary, or a violation of RFC 7578"
        raise InputError(f"not a readable form: {reason}") from error
    return form.multi_items()


async def await_result(request: Request, work: asyncio.Future[Any], seconds: float | None = None) -> Any:
    """Return the result of ``work``, or cancel it if the client disconnects or ``seconds`` pass first.

    Raises ``Refused`` if the work is cancelled.
    """

    async def wait_for_disconnect() -> None:
        while (await request.receive())["type"] != "http.disconnect":
            pass

    leaving, reason = asyncio.create_task(wait_for_disconnect()), "cancelled"
    try:
        await asyncio.wait({work, leaving}, timeout=seconds, return_when=asyncio.FIRST_COMPLETED)
        if work.done():
            return work.result()
        if leaving.done():
            raise Refused(CLIENT_GONE, "the client has left")
        reason = "timeout"
        raise Refused(504, f"no answer within {seconds:g} s")
    finally:
        leaving.cancel()
        work.cancel(reason)


# The OpenAPI description.


def photo_request(*without: str) -> dict[str, Any]:
    """Return the OpenAPI parameters and body of a request with a photo, except the fields named in ``without``."""
    form = PhotoForm.model_json_schema()
    for name in without:
        del form["properties"][name]
    file = {"schema": form["properties"]["photo"]}
    return {
        "parameters": [
            {"name": name, "in": "query", "schema": each}
            for name, each in form["properties"].items()
            if name not in ("photo", "depth")
        ],
        "requestBody": {
            "required": True,
            "content": {
                "multipart/form-data": {"schema": form},
                "image/*": file,
                "application/octet-stream": file,
            },
        },
    }


def json_request(model: Any) -> dict[str, Any]:
    """Return the OpenAPI body of a request with JSON that matches ``model``."""
    schema = model.model_json_schema(ref_template="#/components/schemas/{model}")
    return {"requestBody": {"required": True, "content": {"application/json": {"schema": schema}}}}


def error_responses(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """Return the OpenAPI descriptions of error responses, for the ``responses`` argument of a route."""
    headers = {401: "WWW-Authenticate", 429: "Retry-After", 503: "Retry-After"}
    return {
        status: {
            "description": ERRORS[status][1],
            "content": {PROBLEM: {"schema": {"$ref": "#/components/schemas/Problem"}}},
            "headers": {headers[status]: {"schema": {"type": "string"}, "required": True}} if status in headers else {},
        }
        for status in statuses
    }
