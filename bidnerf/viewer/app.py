"""The viewer as an ASGI application: the page, and the API that the page calls."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import re
import tempfile
import threading
import uuid
from collections.abc import AsyncIterator, Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
from fastapi import FastAPI, Request
from pydantic import BaseModel, ConfigDict, Field
from starlette.responses import HTMLResponse, JSONResponse, Response

from bidnerf.results import BAD_INPUT
from bidnerf.service import (
    Application,
    Refused,
    ServiceLimits,
    answered,
    body_of,
    checked,
    errors,
    json_body,
    photo_body,
    photo_of,
    public_message,
    read_upload,
)
from bidnerf.viewer.answer import no_answer
from bidnerf.viewer.pages import MapView, localized, map_of
from bidnerf.viewer.pictures import Json, field_image, jpeg, quick_image
from bidnerf.viewer.scene import shown_map, thumbnail_jpeg
from bidnerf_core.camera import CameraSource, Intrinsics
from bidnerf_core.datasets import Query, QuerySource
from bidnerf_core.errors import Cancelled, InputError
from bidnerf_core.geometry import SE3, pose_from_matrix
from bidnerf_core.io import parse_json, to_plain
from bidnerf_core.localization import Localizer, SearchRecord
from bidnerf_core.progress import job_context

log = logging.getLogger("bidnerf.viewer")

PLACES = 10
"""Maximum number of photos that are uploading, waiting or being localized."""
LARGEST_RENDERING = 1024
"""Longer side (pixels) of renderings from the virtual camera of the page."""


@dataclass(frozen=True, eq=False)
class LiveView:
    """Contents of a live viewer: a map, images that can be localized in it, a trajectory, and a table of results.

    ``camera`` is used for photos sent without a camera; by default, their camera is taken from EXIF or the map. The
    page shows the field of view of ``camera``, and users can change it there.
    """

    localizer: Localizer
    source: QuerySource | None = None
    trajectory: Json | None = None
    results: tuple[Json, ...] = ()
    camera: CameraSource | None = None


Read = Callable[[], tuple[Query, SE3 | None, int]]
"""A function that returns the input of a localization: a query, a start pose or None, and the seed of the search."""


@dataclass
class ShownJob:
    """A localization job and its state, which the page polls."""

    id: str
    name: str
    state: Literal["waiting", "searching", "rendering", "done"] = "waiting"
    record: SearchRecord | None = None
    answer: Json | None = None

    def plain(self, known: str) -> dict[str, Any]:
        """Return the state as JSON values, and the answer unless the client already knows it for this state (``known``)."""
        caption = self.record.steps[-1].caption if self.record is not None and self.record.steps else ""
        said = {"id": self.id, "name": self.name, "state": self.state, "caption": caption}
        return said if self.state == known else said | {"answer": to_plain(self.answer)}

    def run(self, localizer: Localizer, read: Read) -> None:
        """Localize the query that ``read`` returns, and store the answer; if localization fails, the answer states the error."""
        self.state = "searching"
        try:
            query, start, seed = read()
            self.answer = localized(localizer, query, start, seed, self._follow)
        except Cancelled:
            self.answer = no_answer(self.name, "stopped", "the viewer was closed")
        except InputError as error:
            self.answer = no_answer(self.name, BAD_INPUT, str(error))
        except Exception:  # third-party code may raise anything, with paths of this machine in it
            log.exception("internal error while localizing %s", self.name)
            self.answer = no_answer(self.name, "fault", "internal error, which the viewer's log describes")
        finally:
            self.state = "done"

    def _follow(self, record: SearchRecord, answer: Json | None) -> None:
        self.record, self.answer, self.state = record, answer, "rendering" if answer else "searching"


class Jobs:
    """Runs localizations one at a time in a background thread; ``shown`` holds the jobs by id."""

    def __init__(self, localizer: Localizer) -> None:
        self.shown = dict[str, ShownJob]()
        self._localizer, self._closed = localizer, threading.Event()
        self._thread = ThreadPoolExecutor(1, "localizing")

    @contextlib.contextmanager
    def place(self, name: str) -> Iterator[ShownJob]:
        """Yield a new job, which is removed if the block raises an error. Raises ``Refused`` if too many jobs are pending."""
        if sum(each.state != "done" for each in self.shown.values()) >= PLACES:
            headers = {"Retry-After": "5", "Connection": "close"}
            raise Refused(429, f"all {PLACES} places are taken, try again later", headers)
        job = ShownJob(uuid.uuid4().hex, name)
        self.shown[job.id] = job
        try:
            yield job
        except BaseException:
            del self.shown[job.id]
            raise

    def put(self, job: ShownJob, read: Read) -> None:
        """Queue the localization of the query that ``read`` returns."""
        done = [each.id for each in self.shown.values() if each.state == "done"]
        for old in done[: max(0, len(self.shown) - 64)]:  # the answers of 64 localizations stay in memory
            del self.shown[old]
        self._thread.submit(self._run, job, read)

    def close(self) -> None:
        """Discard the waiting localizations, and ask the one in progress to stop."""
        self._closed.set()
        self._thread.shutdown(wait=False, cancel_futures=True)

    def _run(self, job: ShownJob, read: Read) -> None:
        with job_context(cancel=self._closed.is_set):
            job.run(self._localizer, read)


class VirtualCamera(BaseModel):
    """A camera from which the map is rendered. The pose has the axes of WebGL: x right, y up, z backward."""

    model_config = ConfigDict(allow_inf_nan=False)

    pose: Annotated[list[float], Field(min_length=16, max_length=16, description="camera to world, by rows")]
    fov: float = Field(ge=1, le=170, description="degrees from top to bottom")
    width: int = Field(ge=1, le=LARGEST_RENDERING)
    height: int = Field(ge=1, le=LARGEST_RENDERING)
    quick: bool = Field(description="whether a rendering of the surface suffices")

    @property
    def T_world_camera(self) -> SE3:
        """The pose with OpenCV axes. Raises ``InputError`` if the matrix is not a pose."""
        rows = torch.tensor(self.pose, dtype=torch.float64).reshape(4, 4)
        return pose_from_matrix(rows * torch.tensor([1.0, -1.0, -1.0, 1.0]).double(), "pose")

    @property
    def intrinsics(self) -> Intrinsics:
        """The intrinsics, computed from the field of view and the image size."""
        focal = self.height / 2 / math.tan(math.radians(self.fov / 2))
        return Intrinsics(focal, focal, self.width / 2, self.height / 2, self.width, self.height)


def viewer_app(shown: LiveView, token: str | None = None, limits: ServiceLimits | None = None) -> FastAPI:
    """Return the viewer as an ASGI application; ``limits`` apply to uploads.

    Without a ``token``, only requests addressed to localhost are answered.
    """
    limits = limits or ServiceLimits()
    scene, localizer, names = (
        map_of(shown.localizer),
        shown.localizer,
        () if shown.source is None else tuple(shown.source.names),
    )
    usual = replace(shown.camera or CameraSource(), assumed=localizer.assumed_cameras)
    others = replace(usual, hfov=None)  # the page sends the field of view
    state = MapView(
        shown_map(scene, thumbnails=0),
        live=True,
        queries=names,
        trajectory=shown.trajectory,
        results=shown.results,
        hfov=usual.hfov,
        camera_given=others.is_given,
    )
    jobs, painter = Jobs(localizer), ThreadPoolExecutor(1, "rendering")

    @contextlib.asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        try:
            yield
        finally:
            jobs.close()
            painter.shutdown(wait=False, cancel_futures=True)

    app = Application(
        "bidnerf view",
        token,
        "bidnerf_token",
        lifespan=lifespan,
        description="A map, and localizations in it.",
    )

    def queued(job: ShownJob, read: Read) -> Response:
        jobs.put(job, read)
        return JSONResponse({"job": job.id}, 202)

    @app.get("/", response_class=HTMLResponse, summary="The page.")
    async def page() -> Response:
        # The page states a policy for its own scripts.
        headers = {"Content-Security-Policy": "frame-ancestors 'none'", "Referrer-Policy": "no-referrer"}
        return HTMLResponse(state.html(), headers=headers)

    @app.get("/health", summary="Whether the viewer is up; needs no token.")
    async def health() -> Response:
        return JSONResponse({"status": "ok"})

    @app.get("/api/thumbnail/{number}", responses=errors(404), summary="A rendering from a camera of the map.")
    async def thumbnail(number: str) -> Response:
        cameras = scene.info.cameras
        camera = cameras[_index(number, len(cameras), "camera of the map")]
        content = await asyncio.get_running_loop().run_in_executor(painter, thumbnail_jpeg, scene, camera)
        return Response(content, headers={"Cache-Control": "private, max-age=3600"}, media_type="image/jpeg")

    @app.post(
        "/api/photo",
        status_code=202,
        openapi_extra=photo_body("map"),
        responses=errors(400, 408, 413, 429),
        summary="Queue the localization of a photo.",
    )
    async def photo(request: Request) -> Response:
        with jobs.place("photo") as job:
            upload = await photo_of(request, limits)
            if "map" in upload.parameters:
                raise InputError("map is given", expected="none, since the viewer shows one map")
            job.name = upload.name

            def read() -> tuple[Query, SE3 | None, int]:
                with tempfile.TemporaryDirectory(prefix="bidnerf-view-") as folder:
                    try:
                        photos, start = read_upload(upload, others, Path(folder), limits.max_pixels)
                        query = photos.read(0)
                    except InputError as error:
                        raise InputError(public_message(error, Path(folder))) from error
                views = tuple(view.over(scene.bounds.background) for view in query.views)
                return Query(upload.name, views, query.truth, query.depth_rays), start, upload.seed

            return queued(job, read)

    @app.post(
        "/api/query/{number}",
        status_code=202,
        responses=errors(404, 429),
        summary="Queue the localization of an image with which the viewer was started.",
    )
    async def query(number: str) -> Response:
        index = _index(number, len(names), "image with which the viewer was started")
        with jobs.place(names[index]) as job:
            assert shown.source is not None
            source = shown.source
            return queued(job, lambda: (source.read(index), None, 0))

    @app.get("/api/job/{id}", responses=errors(404), summary="The state of a localization, and its answer.")
    async def job(id: str, known: str = "") -> Response:
        found = jobs.shown.get(id)
        if found is None:
            raise Refused(404, "no such localization")
        return JSONResponse(found.plain(known))

    @app.post(
        "/api/view",
        openapi_extra=json_body(VirtualCamera),
        responses=errors(400, 408, 413),
        summary="A rendering from a virtual camera.",
    )
    async def view(request: Request) -> Response:
        body = parse_json(await body_of(request, replace(limits, max_megabytes=0.1)), "", "a camera")
        camera = checked(VirtualCamera, body)
        intrinsics, T, cancelled = camera.intrinsics, camera.T_world_camera, threading.Event()

        def render() -> bytes | None:
            with contextlib.suppress(Cancelled), job_context(cancel=cancelled.is_set):
                if not cancelled.is_set():
                    return jpeg((quick_image if camera.quick else field_image)(scene, intrinsics, T))
            return None

        try:
            content = await answered(request, asyncio.get_running_loop().run_in_executor(painter, render))
        finally:
            cancelled.set()
        return Response(content, media_type="image/jpeg")

    return app


def _index(text: str, count: int, what: str) -> int:
    """Parse an index in a URL, so that no request can name a file. Raises ``Refused`` unless the index is less than ``count``."""
    if not re.fullmatch("[0-9]{1,9}", text) or int(text) >= count:
        raise Refused(404, f"no {what} has that number, expected less than {count}")
    return int(text)
