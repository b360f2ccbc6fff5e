"""The viewer as an ASGI application: the page, and the API that it calls."""

from __future__ import annotations

import asyncio
import contextlib
import hmac
import math
import tempfile
import threading
from collections.abc import AsyncIterator, Awaitable, Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from http.cookies import SimpleCookie
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs

import torch
from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import HTMLResponse, JSONResponse, RedirectResponse, Response
from starlette.routing import Route
from starlette.types import ASGIApp, Receive, Scope, Send

from bidnerf_core.camera import CameraSource, Intrinsics
from bidnerf_core.datasets import Query, QuerySource
from bidnerf_core.errors import Cancelled, InputError
from bidnerf_core.geometry import SE3, pose_from_matrix
from bidnerf_core.localization import Localizer
from bidnerf_core.maps import Map
from bidnerf_core.progress import job_context
from bidnerf_core.service import (
    SAFE,
    Access,
    Refused,
    ServiceLimits,
    Upload,
    body_of,
    json_of,
    problem,
    query_of,
)
from bidnerf_core.viewer.jobs import Busy, Jobs
from bidnerf_core.viewer.packing import jpeg
from bidnerf_core.viewer.page_state import PageState
from bidnerf_core.viewer.rendering import field_image, quick_image
from bidnerf_core.viewer.saving import page_html
from bidnerf_core.viewer.scene import thumbnail_jpeg

COOKIE = "bidnerf_token"
LARGEST_RENDERING = 1024
"""Longer side (pixels) of renderings from the virtual camera of the page."""
PAGE_HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "Content-Security-Policy": "frame-ancestors 'none'",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}


@dataclass(frozen=True, eq=False)
class Shown:
    """What a viewer shows: a map, the images that may be localized in it, and the page."""

    localizer: Localizer
    source: QuerySource | None
    state: PageState
    camera: CameraSource  # of photos whose field of view is not given with them

    @property
    def map(self) -> Map:
        """The map."""
        assert isinstance(self.localizer.scene, Map)
        return self.localizer.scene


def viewer_app(shown: Shown, token: str | None = None, limits: ServiceLimits | None = None) -> Starlette:
    """Return the viewer as an ASGI application; ``limits`` are those of uploads.

    Without a ``token``, only requests that are addressed to localhost are answered.
    """

    @contextlib.asynccontextmanager
    async def lifespan(app: Starlette) -> AsyncIterator[None]:
        app.state.shown, app.state.limits = shown, limits or ServiceLimits()
        app.state.jobs, app.state.painter = Jobs(shown.localizer), ThreadPoolExecutor(1, "rendering")
        try:
            yield
        finally:
            app.state.jobs.close()
            app.state.painter.shutdown(wait=False, cancel_futures=True)

    routes = [
        Route("/", _answering(_page)),
        Route("/health", _answering(_health)),
        Route("/api/thumbnail/{number:int}", _answering(_thumbnail)),
        Route("/api/photo", _answering(_photo), methods=["POST"]),
        Route("/api/query/{number:int}", _answering(_query), methods=["POST"]),
        Route("/api/job/{id}", _answering(_job)),
        Route("/api/view", _answering(_view), methods=["POST"]),
    ]
    middleware = [Middleware(TokenCookie, token=token), Middleware(Access, token=token)]
    return Starlette(routes=routes, lifespan=lifespan, middleware=middleware)


class TokenCookie:
    """Accepts the token from a browser: ``/?token=TOKEN`` stores it as a cookie, which replaces the header that ``Access`` checks."""

    def __init__(self, app: ASGIApp, token: str | None) -> None:
        self.app, self.token = app, token

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if self.token is None or scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        asked = parse_qs(scope["query_string"].decode("latin-1")).get("token", [""])[0]
        if scope["path"] == "/" and hmac.compare_digest(asked.encode(), self.token.encode()):
            away = RedirectResponse("/", 303, PAGE_HEADERS)
            away.set_cookie(COOKIE, self.token, httponly=True, samesite="strict")
            await away(scope, receive, send)
            return
        headers = [(name, value) for name, value in scope["headers"]]
        given = b"; ".join(value for name, value in headers if name == b"cookie").decode("latin-1")
        with contextlib.suppress(Exception):  # a malformed cookie is none
            if (found := SimpleCookie(given).get(COOKIE)) is not None:
                headers.append((b"authorization", f"Bearer {found.value}".encode()))
        await self.app({**scope, "headers": headers}, receive, send)


Handler = Callable[[Request], Awaitable[Response]]


def _answering(handler: Handler) -> Handler:
    """Convert rejected requests and bad input to responses."""

    async def handle(request: Request) -> Response:
        try:
            return await handler(request)
        except Refused as error:
            return problem(error.status, error.detail, error.headers)
        except InputError as error:
            return problem(400, str(error))
        except Busy:
            return problem(429, "several photos are waiting already, try again later", {"Retry-After": "5"})

    return handle


def _json(value: Any, status: int = 200) -> Response:
    return JSONResponse(value, status, SAFE)


async def _page(request: Request) -> Response:
    return HTMLResponse(page_html(request.app.state.shown.state), headers=PAGE_HEADERS)


async def _health(request: Request) -> Response:
    return _json({"status": "ok"})


async def _thumbnail(request: Request) -> Response:
    """Respond with a rendering from a camera of the map, which is given by number, since no request may name a file."""
    scene: Map = request.app.state.shown.map
    number = request.path_params["number"]
    if number >= len(scene.info.cameras):
        raise Refused(404, f"no camera {number}, the map has {len(scene.info.cameras)}")
    loop = asyncio.get_running_loop()
    content = await loop.run_in_executor(
        request.app.state.painter, thumbnail_jpeg, scene, scene.info.cameras[number]
    )
    return Response(content, 200, {**SAFE, "Cache-Control": "private, max-age=3600"}, "image/jpeg")


async def _photo(request: Request) -> Response:
    """Queue the localization of a photo, which is kept in a temporary folder until it is read."""
    state = request.app.state
    query = await query_of(request, await body_of(request, state.limits))
    upload = Upload(query.parameters, query.blocks)

    def read() -> Query:
        with tempfile.TemporaryDirectory(prefix="bidnerf-view-") as folder:
            try:
                localizer, pixels = state.shown.localizer, state.limits.max_megapixels * 1e6
                background = localizer.scene.bounds.background
                photos, _ = upload.read(state.shown.camera, background, Path(folder), pixels)
                return named(photos.read(0), upload.name)
            except InputError as error:
                raise InputError(str(error).replace(f"{folder}/", "")) from error

    return _json({"job": state.jobs.begin(upload.name, read).id}, 202)


def named(query: Query, name: str) -> Query:
    """Return a query under another name."""
    return Query(name, query.views, query.truth, query.depth_rays)


async def _query(request: Request) -> Response:
    """Queue the localization of one of the images with which the viewer was started, given by its number."""
    shown: Shown = request.app.state.shown
    number = request.path_params["number"]
    source = shown.source
    if source is None or number >= len(source.names):
        raise Refused(404, f"no image {number}, expected one of those that the viewer was started with")
    job = request.app.state.jobs.begin(source.names[number], lambda: source.read(number))
    return _json({"job": job.id}, 202)


async def _job(request: Request) -> Response:
    job = request.app.state.jobs.find(request.path_params["id"])
    if job is None:
        raise Refused(404, "no such localization")
    return _json(job.plain(request.query_params.get("known", "")))


async def _view(request: Request) -> Response:
    """Respond with a rendering from the virtual camera of the page, unless the client disconnects before it is done."""
    state = request.app.state
    asked = json_of(await body_of(request, state.limits))
    camera, T, quick = asked_camera(asked)
    cancelled = threading.Event()

    def render() -> bytes | None:
        if cancelled.is_set():
            return None
        scene = state.shown.map
        try:
            with job_context(cancel=cancelled.is_set):
                return jpeg(quick_image(scene, camera, T) if quick else field_image(scene, camera, T))
        except Cancelled:
            return None

    drawing = asyncio.ensure_future(asyncio.get_running_loop().run_in_executor(state.painter, render))
    leaving = asyncio.ensure_future(_left(request))
    waited: list[asyncio.Future[Any]] = [drawing, leaving]
    try:
        await asyncio.wait(waited, return_when=asyncio.FIRST_COMPLETED)
    finally:
        cancelled.set()
        leaving.cancel()
    content = await drawing
    if content is None:
        raise Refused(499, "the viewer has left")
    return Response(content, 200, SAFE, "image/jpeg")


async def _left(request: Request) -> None:
    """Return once the client has closed the connection."""
    while (await request.receive())["type"] != "http.disconnect":
        pass


def asked_camera(asked: Any) -> tuple[Intrinsics, SE3, bool]:
    """Return the camera and the pose in a request, and whether a rendering of the surface suffices.

    The pose has the axes of WebGL: x right, y up, z backward. Raises ``Refused``.
    """
    expected = "expected pose (16 numbers by rows), fov (degrees from top to bottom), width, height and quick"
    try:
        width, height, fov = int(asked["width"]), int(asked["height"]), float(asked["fov"])
        rows = torch.tensor([float(value) for value in asked["pose"]], dtype=torch.float64).reshape(4, 4)
        quick = bool(asked["quick"])
    except (KeyError, TypeError, ValueError, OverflowError, RuntimeError) as error:
        raise Refused(400, f"no camera in it, {expected}") from error
    if not (0 < width <= LARGEST_RENDERING and 0 < height <= LARGEST_RENDERING and 1 <= fov <= 170):
        raise Refused(400, f"a camera of {width}x{height} pixels and {fov} degrees, {expected}")
    if not bool(rows.isfinite().all()):
        raise Refused(400, f"the pose is not finite, {expected}")
    opencv = rows @ torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
    focal = height / 2 / math.tan(math.radians(fov / 2))
    camera = Intrinsics(focal, focal, width / 2, height / 2, width, height)
    return camera, pose_from_matrix(opencv, "pose"), quick
