"""The service as an ASGI application: its routes and its request log."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from importlib.metadata import version
from typing import Any

from fastapi import Depends, FastAPI, Path, Request
from prometheus_client import CONTENT_TYPE_LATEST, generate_latest
from starlette.responses import JSONResponse, PlainTextResponse, Response
from starlette.types import Scope

from bidnerf.service.models import Localization, MapFacts, Refused, checked
from bidnerf.service.pool import Pool
from bidnerf.service.protocols import PROTOCOLS, ServiceProtocol
from bidnerf.service.settings import ServiceLimits
from bidnerf.service.web import (
    Application,
    answered,
    body_of,
    errors,
    json_body,
    log,
    photo_body,
    photo_of,
    problem,
)
from bidnerf_core.errors import InputError
from bidnerf_core.io import parse_json


def application(order: dict[str, Any], limits: ServiceLimits, token: str | None) -> FastAPI:
    """Build the service for the maps, method and device in ``order``, the message that ``worker.main`` receives.

    Clients must send the ``token``, unless it is None. The workers run between ASGI startup and shutdown. Startup
    raises ``InputError`` if a map cannot be served.
    """
    pool, names = Pool(order, limits), list(order["maps"])

    @contextlib.asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        try:
            await pool.start()
            yield
        finally:
            await pool.close()

    def report(scope: Scope, status: int, seconds: float) -> None:
        """Count a request, and log it as one line of JSON."""
        path = getattr(scope.get("route"), "path", "unknown" if status not in (401, 403) else "refused")
        pool.requests.labels(path=path, status=status).inc()
        if scope["method"] == "POST":
            pool.seconds.observe(seconds)
        if scope["method"] == "POST" or status >= 400:
            client = scope.get("client")
            line = {
                "time": round(time.time(), 3),
                "client": client and f"{client[0]}:{client[1]}",
                "method": scope["method"],
                "path": scope["path"][:200],
                "status": status,
                "seconds": round(seconds, 4),
                **scope.get("state", {}).get("facts", {}),
            }
            log.log(logging.ERROR if status >= 500 else logging.INFO, "%s", json.dumps(line))

    app = Application(
        "bidnerf",
        token,
        report=report,
        lifespan=lifespan,
        description=(
            "Poses of photos in radiance fields. Poses are camera to world with OpenCV axes (x right, y down, z forward).\n"
            f"A request has at most {limits.max_megabytes:g} MiB, an image at most {limits.max_megapixels:g} megapixels. Errors are\n"
            "application/problem+json; a method that a path lacks results in 405."
        ),
    )
    app.state.pool, app.state.limits = pool, limits

    async def known(map: str = Path(json_schema_extra={"enum": [*names]})) -> str:
        """Return ``map`` if a map of that name is served. Raises ``Refused`` otherwise."""
        if map not in names:
            raise Refused(404, f"no map with that name, expected one of {', '.join(names)}")
        return map

    @app.get("/", response_model=dict[str, Any], summary="The version, the maps and where this description is.")
    async def index() -> Response:
        return JSONResponse({"bidnerf": version("bidnerf"), "maps": names, "description": "/openapi.json"})

    @app.get(
        "/health",
        response_model=dict[str, str | int],
        responses=errors(503),
        summary="Whether the service can answer; needs no token.",
    )
    async def health() -> Response:
        if not pool.workers:
            return problem(503, "no worker is currently alive", {"Retry-After": "1"})
        return JSONResponse({"status": "ok", "workers": len(pool.workers), "waiting": pool.waiting})

    @app.get("/metrics", response_class=PlainTextResponse, summary="Counters and times for Prometheus.")
    async def metrics() -> Response:
        return Response(generate_latest(pool.registry), headers={"Content-Type": CONTENT_TYPE_LATEST})

    @app.get("/maps", response_model=dict[str, MapFacts], summary="The maps by name, with facts about each.")
    async def maps() -> Response:
        return JSONResponse(pool.described)

    @app.get("/maps/{map}", response_model=MapFacts, responses=errors(404), summary="Facts about a map.")
    async def facts(map: str = Depends(known)) -> Response:
        return JSONResponse(pool.described[map])

    async def localize(request: Request) -> Response:
        with pool.place() as facts:
            upload = await photo_of(request, app.state.limits)
            usual = names[0] if len(names) == 1 else None  # None stands for the map that the photo shows
            name = request.path_params.get("map", upload.parameters.get("map", usual))
            task = {"map": name if name is None else await known(name), "upload": upload}
            return JSONResponse(await _answer(request, facts, task))

    def ask(name: str, protocol: ServiceProtocol) -> Callable[[Request], Awaitable[Response]]:
        async def asked(request: Request) -> Response:
            with pool.place() as facts:
                body = parse_json(await body_of(request, app.state.limits), "", "a JSON object")
                checked(protocol.request, body)
                map = request.path_params.get("map", request.query_params.get("map"))
                if map is None and len(names) > 1:
                    raise InputError("several maps are served", expected=f"map as one of {', '.join(names)}")
                task = {"map": await known(names[0] if map is None else map), "protocol": name, "body": body}
                answer = await _answer(request, facts, task)
            accepts = protocol.media_type.partition(";")[0] in request.headers.get("accept", "")
            return JSONResponse(answer, media_type=protocol.media_type if accepts else "application/json")

        return asked

    async def running() -> Response:
        return JSONResponse({"status": "running"})

    failures = errors(400, 404, 408, 413, 422, 429, 504)
    query = {
        "name": "map",
        "in": "query",
        "required": len(names) > 1,
        "schema": {"type": "string", "enum": names},
    }
    for prefix in ("", "/maps/{map}"):
        in_map: dict[str, Any] = {"dependencies": [Depends(known)] if prefix else []}
        app.post(
            f"{prefix}/localize",
            openapi_extra=photo_body("map") if prefix else photo_body(),
            response_model=Localization,
            responses=failures,
            summary="Find the pose of a photo.",
            **in_map,
            description="The response is that of 'bidnerf localize --json', in several maps if none is named. Never use a pose whose\n"
            "'converged' is false. Each field is given once, in the query or in the form; at most one of focal, hfov and camera.",
        )(localize)
        for name, protocol in PROTOCOLS.items():
            app.get(
                f"{prefix}/{name}",
                response_model=dict[str, str],
                responses=errors(404),
                **in_map,
                summary=f"Whether the endpoint is up: {protocol.summary}",
            )(running)
            app.post(
                f"{prefix}/{name}",
                response_model=protocol.response,
                summary=protocol.summary,
                **in_map,
                openapi_extra={**json_body(protocol.request), "parameters": [] if prefix else [query]},
                responses={200: {"content": {protocol.media_type: {}}}, **failures},
            )(ask(name, protocol))
    return app


async def _answer(request: Request, facts: dict[str, Any], task: dict[str, Any]) -> Any:
    """Return the JSON body of a worker's answer, and add ``facts`` to the request's log entry. Raises ``Refused`` if the request fails."""
    pool: Pool = request.app.state.pool
    upload = task.get("upload")
    facts |= {"map": task["map"], "bytes": 0 if upload is None else sum(map(len, upload.files.values()))}
    request.state.facts = facts
    work = asyncio.create_task(pool.answer(task, facts))
    answer: dict[str, Any] = await answered(request, work, request.app.state.limits.timeout)
    pool.outcomes.labels(map=task["map"] or "", outcome=answer["outcome"]).inc()
    facts |= {key: answer[key] for key in ("outcome", "worker", "fault") if key in answer}
    if answer["status"] != 200:
        raise Refused(answer["status"], answer["detail"], None, **answer.get("more", {}))
    return answer["body"]
