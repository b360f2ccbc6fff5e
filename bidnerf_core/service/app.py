"""The service as an ASGI application: its paths and its log."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import os
import tempfile
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from importlib.metadata import version
from typing import Any, Literal

from fastapi import FastAPI, Request
from prometheus_client import CONTENT_TYPE_LATEST
from pydantic import BaseModel
from starlette.responses import JSONResponse, PlainTextResponse, Response
from starlette.types import Scope

from bidnerf_core.errors import InputError
from bidnerf_core.io import parse_json
from bidnerf_core.service.jobs import Job
from bidnerf_core.service.models import Health, Localization, MapFacts, Refused, Service, checked
from bidnerf_core.service.pool import Lost, Pool
from bidnerf_core.service.protocols import PROTOCOLS, ServiceProtocol
from bidnerf_core.service.settings import ServiceLimits
from bidnerf_core.service.web import (
    CLIENT_GONE,
    UPLOAD_ERRORS,
    body_of,
    errors,
    json_body,
    left,
    log,
    new_app,
    photo_body,
    photo_of,
    problem,
)

DESCRIPTION = """Poses of photos in radiance fields. Poses are camera to world with OpenCV axes (x right, y down, z forward).
A request has at most {0.max_megabytes:g} MiB, an image at most {0.max_megapixels:g} megapixels. Errors are
application/problem+json; a method that a path lacks results in 405."""
LOCALIZE = """The response is that of 'bidnerf localize --json', in several maps if none is named. Never use a pose whose
'converged' is false. Each field is given once, in the query or in the form; at most one of focal, hfov and camera."""
FAILURES = (*UPLOAD_ERRORS, 404, 422, 504)


class Running(BaseModel):
    """Whether the endpoint is up."""

    status: Literal["running"]


def application(order: dict[str, Any], limits: ServiceLimits, token: str | None) -> FastAPI:
    """Build the service for the maps, method and device of an ``order``, see ``worker.main``; it runs between ASGI startup and
    shutdown.

    Its startup raises ``InputError`` if a map cannot be served.
    """
    pool = Pool(order, limits)

    @contextlib.asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        try:
            await asyncio.to_thread(pool.start)
            yield
        finally:
            await asyncio.to_thread(pool.close)

    def report(scope: Scope, status: int, seconds: float) -> None:
        """Count a request, and write one line of JSON about it to the log."""
        facts = scope.get("state", {}).get("facts", {})
        path = getattr(scope.get("route"), "path", "unknown" if status not in (401, 403) else "refused")
        pool.metrics.requests.labels(path=path, status=status).inc()
        if scope["method"] == "POST":
            pool.metrics.seconds.observe(seconds)
        if scope["method"] == "POST" or status >= 400:
            client = scope.get("client")
            line = {
                "time": round(time.time(), 3), "client": client and f"{client[0]}:{client[1]}", "method": scope["method"],
                "path": scope["path"][:200], "status": status, "seconds": round(seconds, 4), **facts,
            }  # fmt: skip
            log.log(logging.ERROR if status >= 500 else logging.INFO, "%s", json.dumps(line))

    names = list(order["maps"])
    app = new_app("bidnerf", DESCRIPTION.format(limits), token, report=report, lifespan=lifespan)
    app.state.pool, app.state.limits, app.state.names = pool, limits, names

    @app.get("/", response_model=Service, summary="The version, the maps and where this description is.")
    async def index() -> Response:
        return _json({"bidnerf": version("bidnerf"), "maps": names, "description": "/openapi.json"})

    @app.get(
        "/health",
        response_model=Health,
        responses=errors(503),
        summary="Whether the service can answer; needs no token.",
    )
    async def health() -> Response:
        alive = len(pool.alive)
        if not alive:
            return problem(503, "no worker is currently alive", {"Retry-After": "1"})
        folder = tempfile.gettempdir()
        if os.path.isdir(folder) and not os.access(folder, os.W_OK):
            return problem(503, "the folder for temporary files cannot be written", {"Retry-After": "60"})
        return _json({"status": "ok", "workers": alive, "waiting": pool.queue.waiting})

    @app.get("/metrics", response_class=PlainTextResponse, summary="Counters and times for Prometheus.")
    async def metrics() -> Response:
        return Response(pool.metrics.text(), headers={"Content-Type": CONTENT_TYPE_LATEST})

    @app.get("/maps", response_model=dict[str, MapFacts], summary="The maps by name, with facts about each.")
    async def maps() -> Response:
        return _json(pool.described)

    async def facts(request: Request) -> Response:
        return _json(pool.described[_chosen(request)])

    async def localize(request: Request) -> Response:
        with pool.queue.place() as job:
            upload = await photo_of(request, limits)
            name = dict(upload.parameters).get("map")
            nowhere = name is None and "map" not in request.path_params and len(names) > 1
            task = {"map": None if nowhere else _chosen(request, name), "upload": upload}
            return _json(await _answer(request, job, task))

    app.get(
        "/maps/{map}",
        **_in_map({}),
        response_model=MapFacts,
        responses=errors(404),
        summary="Facts about a map.",
    )(facts)
    _add(
        app, "POST", "/localize", localize, photo_body(), photo_body("map"), response_model=Localization,
        responses=errors(*FAILURES), summary="Find the pose of a photo.", description=LOCALIZE,
    )  # fmt: skip
    for name, protocol in PROTOCOLS.items():
        _add_protocol(app, name, protocol)
    return app


def _add(
    app: FastAPI, method: str, path: str, handle: Callable[[Request], Awaitable[Response]], body: dict[str, Any],
    in_map_body: dict[str, Any], **more: Any,
) -> None:  # fmt: skip
    """Add a path, and the one of each map; ``body`` and ``in_map_body`` are what OpenAPI says of their requests."""
    app.api_route(path, methods=[method], openapi_extra=body, **more)(handle)
    app.api_route(f"/maps/{{map}}{path}", methods=[method], **_in_map(in_map_body), **more)(handle)


def _in_map(body: dict[str, Any]) -> dict[str, Any]:
    parameters = [_map_in("path", True), *body.get("parameters", ())]
    return {"openapi_extra": body | {"parameters": parameters}}


def _map_in(place: str, required: bool) -> dict[str, Any]:
    return {"name": "map", "in": place, "required": required, "schema": {"type": "string"}}


def _add_protocol(app: FastAPI, name: str, protocol: ServiceProtocol) -> None:
    """Add the paths of another protocol."""
    pool: Pool = app.state.pool

    async def ask(request: Request) -> Response:
        with pool.queue.place() as job:
            body = parse_json(await body_of(request, app.state.limits), "", "a JSON object")
            checked(protocol.request, body)
            chosen = _chosen(request, request.query_params.get("map"))
            answer = await _answer(request, job, {"map": chosen, "protocol": name, "body": body})
        accepts = protocol.media_type.partition(";")[0] in request.headers.get("accept", "")
        return _json(answer, protocol.media_type if accepts else "application/json")

    async def running(request: Request) -> Response:
        if "map" in request.path_params:
            _chosen(request)
        return _json({"status": "running"})

    summary = f"Whether the endpoint is up: {protocol.summary}"
    _add(
        app,
        "GET",
        f"/{name}",
        running,
        {},
        {},
        response_model=Running,
        responses=errors(404),
        summary=summary,
    )
    body = json_body(protocol.request)
    answered: dict[int | str, Any] = {200: {"content": {protocol.media_type: {}}}}
    _add(
        app, "POST", f"/{name}", ask, body | {"parameters": [_map_in("query", len(app.state.names) > 1)]}, body,
        response_model=protocol.response, responses=errors(*FAILURES) | answered, summary=protocol.summary,
    )  # fmt: skip


def _chosen(request: Request, name: str | None = None) -> str:
    """Return the name of the map that a request is for: in its path, else the given one, else the only one.

    Raises ``Refused`` for an unknown one, and ``InputError`` if one has to be named.
    """
    names: list[str] = request.app.state.names
    name = request.path_params.get("map", name)
    if name is None:
        if len(names) > 1:
            raise InputError("several maps are served", expected=f"map as one of {', '.join(names)}")
        return names[0]
    if name not in names:
        raise Refused(404, f"no map with that name, expected one of {', '.join(names)}")
    return name


async def _answer(request: Request, job: Job, task: dict[str, Any]) -> Any:
    """Return the JSON of a worker's answer; stop the work if it takes too long or the client disconnects. Raises ``Refused``."""
    pool: Pool = request.app.state.pool
    seconds = request.app.state.limits.timeout
    upload = task.get("upload")
    sizes = [] if upload is None else map(len, upload.files.values())
    request.state.facts = facts = {"id": job.id, "map": task["map"], "bytes": sum(sizes)}
    pool.queue.put(job, task)
    answering, leaving = asyncio.wrap_future(job.result), asyncio.ensure_future(left(request))
    try:
        await asyncio.wait({answering, leaving}, timeout=seconds, return_when=asyncio.FIRST_COMPLETED)
        if not answering.done():
            job.stop("cancelled" if leaving.done() else "timeout")
            if leaving.done():
                raise Refused(CLIENT_GONE, "the client has left")
            raise Refused(504, f"no answer within {seconds:g} s")
        answer: dict[str, Any] = answering.result()
    except Lost as error:
        raise Refused(422, "the request crashed every worker that took it") from error
    finally:
        leaving.cancel()
        facts |= {"attempts": job.attempts, "waited": None if job.waited is None else round(job.waited, 4)}
    pool.metrics.outcomes.labels(map=task["map"] or "", outcome=answer["outcome"]).inc()
    facts |= {key: answer[key] for key in ("outcome", "worker", "fault") if key in answer}
    if answer["status"] != 200:
        raise Refused(answer["status"], answer["detail"], None, **answer.get("more", {}))
    return answer["body"]


def _json(value: Any, media_type: str = "application/json") -> Response:
    return JSONResponse(value, media_type=media_type)
