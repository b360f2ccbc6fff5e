"""What the applications of ``serve`` and ``view`` share: access, errors, the log, reading requests, and their description."""

from __future__ import annotations

import asyncio
import json
import logging
import time
from collections.abc import AsyncGenerator, Callable, Mapping
from importlib.metadata import version
from importlib.resources import files
from pathlib import PurePosixPath
from typing import Any

import jinja2
from fastapi import FastAPI, Request
from fastapi.openapi.utils import get_openapi
from starlette.datastructures import MutableHeaders, UploadFile
from starlette.exceptions import HTTPException
from starlette.formparsers import MultiPartException, MultiPartParser
from starlette.requests import ClientDisconnect
from starlette.responses import HTMLResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from bidnerf_core.errors import InputError, spelling_hint
from bidnerf_core.service.access import OPEN, refusal
from bidnerf_core.service.models import (
    LONGEST_NAME,
    PhotoForm,
    PhotoParameters,
    Problem,
    Refused,
    Upload,
    checked,
    short,
)
from bidnerf_core.service.settings import MEBIBYTE, ServiceLimits

log = logging.getLogger("bidnerf.service")

SAFE = {
    "X-Content-Type-Options": "nosniff",
    "Content-Security-Policy": "default-src 'none'; frame-ancestors 'none'",
    "Cache-Control": "no-store",
}
"""Headers of every response that has none of its own: names in it are text, whatever a browser might make of them."""
PROBLEM = "application/problem+json"
CLIENT_GONE = 499
"""The status in the log and the metrics for a client that disconnected before the response; nobody receives it."""
ERRORS = {
    400: ("bad request", "The request is malformed: the detail states what was found and what is expected."),
    401: ("no valid token", "The request does not carry the token of the service."),
    403: ("not allowed", "Without a token, only programs on the service's own machine may send requests."),
    404: ("not found", "There is no such thing."),
    405: ("method not allowed", "The path lacks this method."),
    408: ("upload too slow", "The request did not arrive in time."),
    413: ("too large", "The request is too large."),
    422: ("not localized", "The photo cannot be read or localized at all, or what is known about it contradicts it."),
    429: ("too many requests", "The service is full."),
    500: ("internal error", "An error in the service itself, which its log describes."),
    503: ("not available", "The service cannot answer at present."),
    504: ("took too long", "The answer took too long."),
}  # fmt: skip
"""Titles and descriptions of errors."""
UPLOAD_ERRORS = (400, 408, 413, 429)
"""The errors of every request with a body."""
HEADERS = {
    "Cache-Control": "Answers are not cached unless they say so.",
    "Content-Security-Policy": "Nothing in an answer is ever run or framed.",
    "X-Content-Type-Options": "The type of an answer is not to be guessed: nosniff.",
    "Retry-After": "Whole seconds after which to try again.",
    "WWW-Authenticate": "How to authenticate: Bearer.",
}
FILES = ("photo", "depth", "camera", "start")
"""The parts of a form that may be files. ``camera`` and ``start`` may be query parameters as well."""

REFERENCE = "#/components/schemas/{model}"

Report = Callable[[Scope, int, float], None]
"""Receives the scope, status and duration (seconds) of each request."""


def new_app(
    title: str, description: str, token: str | None, cookie: str | None = None, report: Report | None = None, **more: Any
) -> FastAPI:  # fmt: skip
    """Return an application that answers errors in the format of RFC 9457 and describes itself, see ``refusal`` for its access."""
    app = FastAPI(
        title=title, description=description, version=version("bidnerf"), openapi_url=None, docs_url=None, redoc_url=None,
        redirect_slashes=False, generate_unique_id_function=lambda route: f"{min(route.methods or ()).lower()} {route.path}", **more,
    )  # fmt: skip
    app.add_middleware(Gate, token=token, cookie=cookie, report=report)
    for kind in (Refused, InputError, HTTPException):
        app.add_exception_handler(kind, _failure)
    app.openapi = lambda: described(app, 401 if token is not None else 403)  # type: ignore[method-assign]

    @app.get("/openapi.json", summary="This description, in the format of OpenAPI 3.1.")
    async def openapi() -> dict[str, Any]:
        return app.openapi()

    @app.get("/docs", summary="This description, as a page.", response_class=HTMLResponse)
    async def docs() -> HTMLResponse:
        template = files(__package__).joinpath("docs.html").read_text(encoding="utf-8")
        page = jinja2.Environment(autoescape=True).from_string(template).render(api=app.openapi())
        policy = "default-src 'none'; style-src 'unsafe-inline'; frame-ancestors 'none'"
        return HTMLResponse(page, headers={"Content-Security-Policy": policy})

    return app


class Gate:
    """What every request passes: the check of its access, the headers of every response, and the report of how it went."""

    def __init__(
        self, app: ASGIApp, token: str | None, cookie: str | None = None, report: Report | None = None
    ) -> None:
        self.app, self.token, self.cookie, self.report = app, token, cookie, report

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "websocket":
            await send({"type": "websocket.close", "code": 1008})
            return
        if scope["type"] != "http":  # the startup and the shutdown
            await self.app(scope, receive, send)
            return
        began, status = time.perf_counter(), 0

        async def answer(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status, headers = message["status"], MutableHeaders(raw=list(message["headers"]))
                for name, value in SAFE.items():
                    headers.setdefault(name, value)
                message = {**message, "headers": headers.raw}
            await send(message)

        cookie = None if self.cookie is None else f"{self.cookie}_{scope['server'][1]}"
        refused = refusal(scope, self.token, cookie)
        try:
            if refused is None:
                await self.app(scope, receive, answer)
            else:
                more = {"Connection": "close"} | ({"WWW-Authenticate": "Bearer"} if refused[0] == 401 else {})
                await problem(*refused, more)(scope, receive, answer)
        except Exception as error:  # an internal error: the operator has to see where it happened
            log.exception("%s", json.dumps({"fault": f"{type(error).__name__}: {error}"}))
            if not status:
                await problem(500, "internal error")(scope, receive, answer)
        if self.report is not None:
            self.report(scope, status, time.perf_counter() - began)


def problem(status: int, detail: str, headers: Mapping[str, str] | None = None, **more: Any) -> Response:
    """Return an error response in the format of RFC 9457."""
    title = ERRORS[status][0] if status in ERRORS else "error"
    body = {"title": title, "status": status, "detail": detail, **more}
    return Response(json.dumps(body), status, headers, PROBLEM)


async def _failure(request: Request, error: Exception) -> Response:
    """Return the response to a request that failed with an error of its client."""
    if isinstance(error, Refused):
        return problem(error.status, error.detail, error.headers, **error.more)
    if isinstance(error, HTTPException):
        path = getattr(request.scope.get("route"), "path", None)
        if error.status_code == 405:  # of the methods of a path, each has a route, which knows only its own
            same = [route for route in request.app.routes if route.path == path]
            methods = sorted({method for route in same for method in route.methods})
            return problem(405, error.detail, {"Allow": ", ".join(methods)})
        return problem(error.status_code, error.detail, error.headers)
    return problem(400, str(error))


# Requests.


async def body_of(request: Request, limits: ServiceLimits) -> bytes:
    """Read the body of a request. Raises ``Refused`` for one that is too large or does not arrive in time."""
    close = {"Connection": "close"}  # the rest of the body is not read
    announced = request.headers.get("content-length", "0")
    most = f"expected at most {limits.max_megabytes:g} MiB"
    if not (announced.isascii() and announced.isdigit() and len(announced) <= 20):
        raise Refused(400, f"Content-Length is {short(announced)}, expected a number", close)
    if int(announced) > limits.max_bytes:
        raise Refused(413, f"the request has {int(announced) / MEBIBYTE:,.0f} MiB, {most}", close)
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


async def photo_of(request: Request, limits: ServiceLimits) -> Upload:
    """Read a photo and what is known about it: a form, or the bytes of the photo with query parameters. Raises ``Refused``."""
    content = await body_of(request, limits)
    values, sent = dict[str, Any](), dict[str, bytes]()

    def add(name: str, value: str | bytes) -> None:
        if name in values or name in sent:
            raise InputError(f"{name} is given twice", expected="once")
        if name in ("photo", "depth") and isinstance(value, bytes):
            sent[name] = value
        else:
            values[name] = value.decode("utf-8", "replace") if isinstance(value, bytes) else value

    for name, text in request.query_params.multi_items():
        add(name, text)
    kind, stem = request.headers.get("content-type", "").partition(";")[0].strip().lower(), ""
    if kind != "multipart/form-data":
        add("photo", content)
    else:
        for name, part in await _parts(request, content):
            if isinstance(part, UploadFile) and name not in FILES:
                hint = spelling_hint(name, FILES, f", expected any of {', '.join(FILES)}")
                raise InputError(f"unknown file {short(name)}{hint}")
            if name == "photo" and isinstance(part, UploadFile):
                stem = PurePosixPath((part.filename or "").replace("\\", "/")).stem[:LONGEST_NAME]
            add(name, await part.read() if isinstance(part, UploadFile) else part)
    parameters = checked(PhotoParameters, values).model_dump(exclude_unset=True)
    if not sent.get("photo"):
        raise InputError("no photo", expected="its bytes as the body, or a form with a file 'photo'")
    if "depth_unit" in parameters and "depth" not in sent:
        raise InputError("depth_unit was given without depth", expected="the depth image that it belongs to")
    # The stem of a file's name is text in the answer, never a file name; a given name takes precedence.
    return Upload(({"name": stem} if stem else {}) | parameters, sent)


class _InMemory(MultiPartParser):
    """A parser that keeps files in memory, since their size is already limited, rather than on disk."""

    spool_max_size = 2**40


async def _parts(request: Request, content: bytes) -> list[tuple[str, str | UploadFile]]:
    async def once() -> AsyncGenerator[bytes, None]:
        yield content

    most = len(PhotoForm.model_fields)
    try:
        parser = _InMemory(request.headers, once(), max_files=most, max_fields=most, max_part_size=MEBIBYTE)
        return (await parser.parse()).multi_items()
    except (MultiPartException, KeyError, ValueError, LookupError) as error:
        reason = getattr(error, "message", None) or "no boundary, or a violation of RFC 7578"
        raise InputError(f"not a readable form: {reason}") from error


async def left(request: Request) -> None:
    """Return once the client has closed the connection."""
    while (await request.receive())["type"] != "http.disconnect":
        pass


# The description.


def photo_body(*without: str) -> dict[str, Any]:
    """Return what OpenAPI says of a request with a photo: its parameters and its body, leaving some out."""
    file = {"type": "string", "format": "binary"}
    form, known = (model.model_json_schema() for model in (PhotoForm, PhotoParameters))
    for schema in (form, known):
        schema["properties"] = {
            name: each for name, each in schema["properties"].items() if name not in without
        }
    parameters = [{"name": name, "in": "query", "schema": each} for name, each in known["properties"].items()]
    kinds = {kind: {"schema": file} for kind in ("image/*", "application/octet-stream")}
    return {
        "parameters": parameters,
        "requestBody": {"required": True, "content": {"multipart/form-data": {"schema": form}, **kinds}},
    }


def json_body(model: Any) -> dict[str, Any]:
    """Return what OpenAPI says of a request with JSON."""
    schema = model.model_json_schema(ref_template=REFERENCE)
    return {"requestBody": {"required": True, "content": {"application/json": {"schema": schema}}}}


def errors(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """Return error responses, as ``responses`` of a path; ``described`` fills them."""
    return {status: {} for status in statuses}


def described(app: FastAPI, refused: int) -> dict[str, Any]:
    """Return the description of an application, whose every path may refuse a request with the status ``refused``."""
    if app.openapi_schema is not None:
        return app.openapi_schema
    api = get_openapi(
        title=app.title, version=app.version, description=app.description, routes=app.routes,
        separate_input_output_schemas=False,
    )  # fmt: skip
    schemas = api.setdefault("components", {}).setdefault("schemas", {})
    for unused in ("HTTPValidationError", "ValidationError"):
        schemas.pop(unused, None)
    schemas["Problem"] = Problem.model_json_schema(ref_template=REFERENCE)
    schemas |= schemas["Problem"].pop("$defs", {})
    content = {PROBLEM: {"schema": {"$ref": "#/components/schemas/Problem"}}}
    names = getattr(app.state, "names", ())
    for path, operations in api["paths"].items():
        for operation in operations.values():
            responses = operation["responses"]
            for body in operation.get("requestBody", {"content": {}})["content"].values():
                schemas |= body["schema"].pop("$defs", {})
            for each in operation.get("parameters", ()):
                each["schema"] |= {"enum": [*names]} if each["name"] == "map" else {}
            is_open = path == OPEN and refused == 401
            if "HTTPValidationError" in json.dumps(responses.get("422", {})):
                del responses["422"]  # paths that FastAPI believes to check their parameters by itself
            for status in (500,) if is_open else (refused, 500):
                responses[str(status)] = {}
            for status, response in responses.items():
                if int(status) >= 400:
                    response |= {"description": ERRORS[int(status)][1], "content": content}
                also = {"401": "WWW-Authenticate", "429": "Retry-After", "503": "Retry-After"}.get(status)
                response["headers"] = {
                    name: {"$ref": f"#/components/headers/{name}"} for name in (*SAFE, also) if name
                }
            operation["responses"] = dict(sorted(responses.items()))
            if is_open:
                operation["security"] = []
    number = {"type": "integer", "minimum": 1}
    api["components"]["headers"] = {
        name: {"description": text, "required": True, "schema": number if name == "Retry-After" else {"type": "string"}}
        for name, text in HEADERS.items()
    }  # fmt: skip
    if refused == 401:
        api["components"]["securitySchemes"] = {"token": {"type": "http", "scheme": "bearer"}}
    api["security"] = [{"token": []}] if refused == 401 else []
    app.openapi_schema = api
    return api
