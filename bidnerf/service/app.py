"""The service as an ASGI application: its routes and its request log."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import time
import traceback
from collections.abc import AsyncIterator
from importlib.metadata import version
from typing import Any

from fastapi import Depends, FastAPI, Path, Request
from prometheus_client import CONTENT_TYPE_LATEST, generate_latest
from starlette.responses import JSONResponse, PlainTextResponse, Response
from starlette.types import Scope

from bidnerf.service.models import LocalizationBody, MapFacts, Refused
from bidnerf.service.pool import Pool
from bidnerf.service.protocols import SERVICES, ServiceProtocol
from bidnerf.service.settings import ServiceLimits
from bidnerf.service.web import (
    FAILED,
    OPEN,
    Application,
    await_result,
    error_responses,
    json_request,
    photo_request,
    problem,
    read_body,
    read_photo,
    service_log,
)
from bidnerf_core.errors import InputError

MOST_VALUES = 10_000
"""Largest number of JSON values in a request to a protocol."""
FAILURES = error_responses(400, 404, 408, 413, 422, 429, 503, 504)
"""The responses to a request for a pose that is refused or fails."""


def application(order: dict[str, Any], limits: ServiceLimits, token: str | None) -> Application:
    """Build the service for the maps, method and device in ``order``, the message that ``worker.main`` receives.

    Clients must send the ``token``, unless it is None. The workers run between ASGI startup and shutdown. Startup
    raises ``InputError`` if a map cannot be served.
    """
    pool = Pool(order, limits)

    @contextlib.asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        try:
            await pool.start()
            yield
        finally:
            await pool.close()

    app = Application(
        "bidnerf",
        token,
        report=report_request,
        lifespan=lifespan,
        description=(
            "Poses of photos in radiance fields. Poses are camera to world with OpenCV axes (x right, y down, z forward).\n"
            f"A request has at most {limits.max_megabytes:g} MiB, an image at most {limits.max_megapixels:g} megapixels. Errors are\n"
            "application/problem+json; a method that a path lacks results in 405."
        ),
    )
    app.state.pool, app.state.limits = pool, limits

    async def find_map(map: str = Path(json_schema_extra={"enum": [*pool.map_facts]})) -> str:
        _require_map(pool, map)
        return map

    @app.get(
        "/",
        response_model=dict[str, Any],
        summary="Get the version, the names of the maps and the addresses of this description.",
    )
    async def index() -> Response:
        return JSONResponse(
            {"bidnerf": version("bidnerf"), "maps": [*pool.map_facts], "description": "/openapi.json", "docs": "/docs"}
        )

    @app.get(
        OPEN,
        response_model=dict[str, str | int],
        responses=error_responses(503),
        summary="Get whether the service can answer; needs no token.",
    )
    async def health() -> Response:
        if not pool.workers:
            return problem(503, "no worker is currently alive", {"Retry-After": "1"})
        return JSONResponse({"status": "ok", "workers": len(pool.workers), "waiting": pool.queue.waiting})

    @app.get("/metrics", response_class=PlainTextResponse, summary="Get counters and times for Prometheus.")
    async def metrics() -> Response:
        return Response(generate_latest(pool.registry), headers={"Content-Type": CONTENT_TYPE_LATEST})

    @app.get("/maps", response_model=dict[str, MapFacts], summary="Get facts about all maps, by name.")
    async def maps() -> Response:
        return JSONResponse(pool.map_facts)

    @app.get("/maps/{map}", response_model=MapFacts, responses=error_responses(404), summary="Get facts about a map.")
    async def facts(map: str = Depends(find_map)) -> Response:
        return JSONResponse(pool.map_facts[map])

    for prefix, of_map in (("", []), ("/maps/{map}", [Depends(find_map)])):
        app.post(
            f"{prefix}/localize",
            openapi_extra=photo_request(*["map"] if prefix else []),
            response_model=LocalizationBody,
            responses=FAILURES,
            dependencies=of_map,
            summary="Find the pose of a photo.",
            description="The response is that of 'bidnerf localize --json', in several maps if none is named. Never use a pose whose\n"
            "'converged' is false. Each field is given once, in the query or in the form; at most one of focal, hfov and camera.",
        )(localize)
        for name, protocol in SERVICES.items():
            _add_protocol(app, f"{prefix}/{name}", name, protocol, of_map)
    return app


def _add_protocol(app: FastAPI, path: str, name: str, protocol: ServiceProtocol, of_map: list[Any]) -> None:
    """Add the routes of a protocol at ``path``; ``of_map`` are the dependencies of a path that names the map."""
    names = [*app.state.pool.map_facts]
    query = {"name": "map", "in": "query", "required": len(names) > 1, "schema": {"type": "string", "enum": names}}

    @app.get(
        path,
        response_model=dict[str, str],
        responses=error_responses(404),
        dependencies=of_map,
        summary=f"Get whether this endpoint is up: {protocol.summary}",
    )
    async def status() -> Response:
        return JSONResponse({"status": "running"})

    @app.post(
        path,
        response_model=protocol.response,
        responses={200: {"content": {protocol.media_type: {}}}, **FAILURES},
        dependencies=of_map,
        summary=protocol.summary,
        openapi_extra={**json_request(protocol.request), "parameters": [] if of_map else [query]},
    )
    async def answer(request: Request) -> Response:
        with app.state.pool.queue.slot():
            body = await read_body(request, app.state.limits)  # which the worker parses
            # A value takes a hundred times the memory of the character that separates it from the next one.
            if (values := sum(body.count(mark) for mark in (b",", b"[", b"{"))) > MOST_VALUES:
                raise InputError(f"has {values:,} values", expected=f"a JSON object of at most {MOST_VALUES:,}")
            map = request.path_params.get("map", request.query_params.get("map"))
            if map is None and len(names) > 1:
                raise InputError("several maps are served", expected=f"map as one of {', '.join(names)}")
            content = await _ask_worker(
                request, {"map": names[0] if map is None else map, "protocol": name, "body": body}
            )
        accepts = protocol.media_type.partition(";")[0] in request.headers.get("accept", "")
        return JSONResponse(content, media_type=protocol.media_type if accepts else "application/json")


async def localize(request: Request) -> Response:
    """Find the pose of the photo in a request, in the map named by the path or the form, else in the map that the photo shows."""
    pool: Pool = request.app.state.pool
    with pool.queue.slot():
        upload = await read_photo(request, request.app.state.limits)
        usual = next(iter(pool.map_facts)) if len(pool.map_facts) == 1 else None
        map = request.path_params.get("map", upload.parameters.get("map", usual))
        return JSONResponse(await _ask_worker(request, {"map": map, "upload": upload}))


async def _ask_worker(request: Request, task: dict[str, Any]) -> Any:
    """Return the JSON body of a worker's answer to a task. Raises ``Refused`` if there is no such map or the request fails."""
    pool: Pool = request.app.state.pool
    map, upload = task["map"], task.get("upload")
    if map is not None:
        _require_map(pool, map)
    size = len(task.get("body", b"")) if upload is None else sum(len(content) for content in upload.files.values())
    # The log entry of the request, which is completed while a worker answers.
    facts = {"attempts": 0, "waited": None, "map": map, "bytes": size}
    request.state.facts = facts
    work = asyncio.create_task(pool.answer(task, facts))
    answer: dict[str, Any] = await await_result(request, work, request.app.state.limits.timeout)
    pool.outcomes.labels(map=map or "", outcome=answer["outcome"]).inc()
    facts |= {key: answer[key] for key in ("outcome", "worker", "fault") if key in answer}
    if answer["status"] != 200:
        raise Refused(
            answer["status"], answer["detail"] or FAILED.format(request.state.id), None, **answer.get("more", {})
        )
    return answer["body"]


def _require_map(pool: Pool, name: str) -> None:
    """Raise ``Refused`` unless a map of that name is served."""
    if name not in pool.map_facts:
        raise Refused(404, f"no map with that name, expected {' or '.join(map(repr, pool.map_facts))}")


def report_request(scope: Scope, status: int, seconds: float, error: Exception | None) -> None:
    """Count a request, and log it as one line of JSON."""
    pool: Pool = scope["app"].state.pool
    path = getattr(scope.get("route"), "path", "unknown" if status not in (401, 403) else "refused")
    pool.requests.labels(path=path, status=status).inc()
    if scope["method"] == "POST":
        pool.seconds.observe(seconds)
    client, state = scope.get("client"), scope["state"]
    line = {
        "time": round(time.time(), 3),
        "id": state["id"],
        "client": client and f"{client[0]}:{client[1]}",
        "method": scope["method"],
        "path": scope["path"][:200],
        "status": status,
        "seconds": round(seconds, 4),
        **state.get("facts", {}),
    }
    if error is not None:
        line |= {
            "fault": f"{type(error).__name__}: {error}",
            "traceback": "".join(traceback.format_exception(error)),
        }
    service_log.log(logging.ERROR if status >= 500 else logging.INFO, "%s", json.dumps(line))
