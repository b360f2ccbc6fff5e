"""The service as an ASGI application: its paths, responses and log."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route
from starlette.types import Scope

from bidnerf_core.service.access import PROBLEM, SAFE, Access, describe_client
from bidnerf_core.service.description import description
from bidnerf_core.service.metrics import TEXT
from bidnerf_core.service.pool import Full, Job, Lost, Pool, TimedOut
from bidnerf_core.service.requests import JSON, Query, Refused, body_of, json_of, query_of
from bidnerf_core.service.settings import ChosenMethod, ServiceLimits

log = logging.getLogger("bidnerf.service")

OSCP = "application/vnd.oscp+json"
CLIENT_GONE = 499
"""The status in the log and the metrics for a client that disconnected before the response; nobody receives it."""
TITLES = {
    400: "bad request", 401: "no valid token", 403: "not allowed", 404: "not found", 405: "method not allowed",
    408: "upload too slow", 413: "too large", 422: "not localized", 429: "too many requests", 500: "internal error",
    503: "not available", 504: "took too long",
}  # fmt: skip

Handler = Callable[[Request], Awaitable[Response]]


def application(
    maps: Mapping[str, Path], limits: ServiceLimits, token: str | None, method: ChosenMethod
) -> Starlette:
    """Build the service for the maps in some folders, by name; it runs between ASGI startup and shutdown.

    Its startup raises ``InputError`` if a map cannot be served.
    """

    @contextlib.asynccontextmanager
    async def lifespan(app: Starlette) -> AsyncIterator[None]:
        pool = Pool(maps, limits, method)
        await pool.start()
        app.state.pool = pool
        try:
            yield
        finally:
            await pool.close()

    routes = [
        Route("/", _logged(_index), name="/"),
        Route("/health", _logged(_health), name="/health"),
        Route("/metrics", _logged(_metrics), name="/metrics"),
        Route("/openapi.json", _logged(_description), name="/openapi.json"),
        Route("/maps", _logged(_maps), name="/maps"),
        Route("/maps/{map}", _logged(_map), name="/maps/{map}"),
        Route("/localize", _logged(_localize), methods=["POST"], name="/localize"),
        Route("/maps/{map}/localize", _logged(_localize), methods=["POST"], name="/maps/{map}/localize"),
        Route("/geopose", _logged(_geopose), methods=["GET", "POST"], name="/geopose"),
        Route("/maps/{map}/geopose", _logged(_geopose), methods=["GET", "POST"], name="/maps/{map}/geopose"),
    ]
    handlers: Any = {HTTPException: _unknown, 405: _unknown}
    app = Starlette(
        routes=routes,
        lifespan=lifespan,
        exception_handlers=handlers,
        middleware=[Middleware(Access, token=token, refused=_refused)],
    )
    app.state.protected = token is not None
    app.router.redirect_slashes = False  # a path with a slash too many is unknown, as every other
    return app


def _logged(handler: Handler) -> Handler:
    """Convert errors to responses, count the request, and write one line of JSON about it to the log."""

    async def handle(request: Request) -> Response:
        began = time.perf_counter()
        request.state.facts = {}
        try:
            response = await handler(request)
        except Refused as error:
            response = problem(error.status, error.detail, error.headers)
        except Exception as error:  # an internal error: the operator has to see where it happened
            log.exception("%s", json.dumps({"fault": f"{type(error).__name__}: {error}"}))
            response = problem(500, "internal error")
        seconds = time.perf_counter() - began
        path = request.scope["route"].name
        pool: Pool = request.app.state.pool
        pool.metrics.requests[path, response.status_code] += 1
        facts = request.state.facts
        if request.method == "POST":
            pool.metrics.seconds.add(seconds)
            _log(request.scope, response.status_code, seconds, facts)
        return response

    return handle


def _refused(scope: Scope, status: int) -> None:
    """Count and log an unauthorized request. Its path may be anything, not only a documented one."""
    scope["app"].state.pool.metrics.requests["refused", status] += 1
    _log(scope, status, 0.0, {})


def _log(scope: Scope, status: int, seconds: float, facts: Mapping[str, Any]) -> None:
    line = {
        "time": round(time.time(), 3), "client": describe_client(scope), "method": scope["method"],
        "path": scope["path"][:200], "status": status, "seconds": round(seconds, 4), **facts,
    }  # fmt: skip
    log.log(logging.ERROR if status >= 500 else logging.INFO, "%s", json.dumps(line))


def problem(status: int, detail: str, headers: Mapping[str, str] | None = None, **more: Any) -> Response:
    """Return an error response in the format of RFC 9457."""
    body = {"title": TITLES.get(status, "error"), "status": status, "detail": detail, **more}
    return Response(json.dumps(body), status, {**SAFE, **(headers or {})}, PROBLEM)


def _json(value: Any, kind: str = JSON) -> Response:
    return Response(json.dumps(value, allow_nan=False) + "\n", 200, SAFE, kind)


async def _unknown(request: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    request.app.state.pool.metrics.requests["unknown", error.status_code] += 1
    _log(request.scope, error.status_code, 0.0, {})
    return problem(error.status_code, error.detail, error.headers)


async def _index(request: Request) -> Response:
    pool: Pool = request.app.state.pool
    return _json(
        {"bidnerf": version("bidnerf"), "maps": list(pool.described), "description": "/openapi.json"}
    )


async def _health(request: Request) -> Response:
    pool: Pool = request.app.state.pool
    alive = len(pool.alive)
    if not alive:
        return problem(503, "no worker is currently alive", {"Retry-After": "1"})
    return _json({"status": "ok", "workers": alive, "waiting": int(pool.metrics.gauges["queue_length"][1]())})


async def _metrics(request: Request) -> Response:
    pool: Pool = request.app.state.pool
    return Response(pool.metrics.text(), 200, {**SAFE, "Content-Type": TEXT})


async def _description(request: Request) -> Response:
    pool: Pool = request.app.state.pool
    return _json(description(list(pool.described), pool.limits, request.app.state.protected))


async def _maps(request: Request) -> Response:
    pool: Pool = request.app.state.pool
    return _json(pool.described)


async def _map(request: Request) -> Response:
    pool: Pool = request.app.state.pool
    return _json(pool.described[str(_chosen(request, None))])


async def _localize(request: Request) -> Response:
    """Respond with the JSON of ``bidnerf localize``."""
    pool: Pool = request.app.state.pool
    with _place(pool):
        content = await body_of(request, pool.limits)
        query = await query_of(request, content)
        del content
        name = _chosen(request, query.parameters.pop("map", None))  # without one, the map is found
        answer = await _answer(request, pool, "localize", name, query, None)
    return _json(answer["body"]) if "body" in answer else _failed(answer)


async def _geopose(request: Request) -> Response:
    """Respond to a request of the GeoPose Protocol; a GET checks that the service runs."""
    pool: Pool = request.app.state.pool
    if request.method != "POST":
        _chosen(request, None)
        return _json({"status": "running"})
    with _place(pool):
        body = json_of(await body_of(request, pool.limits))
        name = _chosen(request, request.query_params.get("map"))
        if name is None:  # the answer refers to one anchor, and prior poses to one world
            names = ", ".join(pool.described)
            raise Refused(400, f"several maps are served, expected map as one of {names}")
        answer = await _answer(request, pool, "geopose", name, Query(), body)
    if "body" not in answer:
        return _failed(answer)
    kind = f"{OSCP};version=2.0" if OSCP in request.headers.get("accept", "") else JSON
    return _json(answer["body"], kind)


@contextlib.contextmanager
def _place(pool: Pool) -> Any:
    try:
        with pool.place():
            yield
    except Full as error:
        headers = {"Retry-After": str(pool.retry_after), "Connection": "close"}
        raise Refused(429, f"all {pool.limits.places} places are taken, try again later", headers) from error


def _chosen(request: Request, asked: str | None) -> str | None:
    """Return the name of the map that a request is for; None if it is for any of several. Raises ``Refused``
    for an unknown one.
    """
    names = list(request.app.state.pool.described)
    asked = request.path_params.get("map", asked)
    if asked is None:
        return str(names[0]) if len(names) == 1 else None
    if asked not in names:
        raise Refused(404, f"no map with that name, expected one of {', '.join(names)}")
    return str(asked)


async def _answer(
    request: Request, pool: Pool, kind: str, name: str | None, query: Query, body: Mapping[str, Any] | None
) -> dict[str, Any]:
    """Return a worker's answer; stop the work if the client disconnects. Raises ``Refused``."""
    loop = asyncio.get_running_loop()
    deadline = loop.time() + pool.limits.timeout
    job = Job(kind, name, query.parameters, query.blocks, deadline, loop.create_future(), body)
    facts = request.state.facts
    facts |= {"id": job.id, "map": name, "bytes": sum(map(len, query.blocks.values()))}
    answering, leaving = asyncio.ensure_future(pool.answer(job)), asyncio.ensure_future(_left(request))
    try:
        await asyncio.wait({answering, leaving}, return_when=asyncio.FIRST_COMPLETED)
        if not answering.done():
            raise Refused(CLIENT_GONE, "the client has left")
        answer = answering.result()
    except TimedOut as error:
        raise Refused(504, f"no answer within {pool.limits.timeout:g} s") from error
    except Lost as error:
        raise Refused(422, "the request crashed every worker that took it") from error
    finally:
        for task in (answering, leaving):
            task.cancel()
        await asyncio.gather(answering, leaving, return_exceptions=True)
        facts |= {"attempts": job.attempts, "waited": None if job.waited is None else round(job.waited, 4)}
    outcome = answer.get("outcome", "bad input" if answer["status"] < 500 else "fault")
    pool.metrics.outcomes[name or "", outcome] += 1
    facts |= {"outcome": outcome, "worker": answer["worker"]}
    if "fault" in answer:
        facts["fault"] = answer["fault"]
    return answer


async def _left(request: Request) -> None:
    """Return once the client has closed the connection."""
    while (await request.receive())["type"] != "http.disconnect":
        pass


def _failed(answer: Mapping[str, Any]) -> Response:
    return problem(answer["status"], answer["detail"], None, **answer.get("extra", {}))
