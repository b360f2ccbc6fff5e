"""The viewer as an ASGI application: the page, and the API that the page calls."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import re
import tempfile
import uuid
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
from fastapi import FastAPI, Request
from pydantic import BaseModel, ConfigDict, Field
from starlette.responses import HTMLResponse, JSONResponse, Response

from bidnerf.results import BAD_INPUT
from bidnerf.service import (
    OPEN,
    Application,
    Refused,
    RequestQueue,
    ServiceLimits,
    ThreadExecutor,
    await_result,
    error_responses,
    json_request,
    photo_request,
    public_message,
    read_body,
    read_photo,
    read_upload,
    validate,
)
from bidnerf.viewer.answer import no_answer
from bidnerf.viewer.pages import MapView, answer_query, single_map
from bidnerf.viewer.pictures import JsonObject, field_image, jpeg, quick_image
from bidnerf.viewer.scene import map_json, thumbnail
from bidnerf_core.camera import CameraSource, Intrinsics
from bidnerf_core.datasets import Query, QuerySource
from bidnerf_core.errors import Cancelled, InputError
from bidnerf_core.geometry import SE3, pose_from_matrix
from bidnerf_core.io import parse_json, to_plain
from bidnerf_core.localization import SearchRecord
from bidnerf_core.maps import Localizer

viewer_log = logging.getLogger("bidnerf.viewer")

SLOTS = 10
"""Maximum number of photos that are uploading, waiting or being localized."""
MOST_ANSWERS = 64
"""Maximum number of finished localizations whose answers stay in memory."""
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
    trajectory: JsonObject | None = None
    results: tuple[JsonObject, ...] = ()
    camera: CameraSource | None = None


Read = Callable[[], tuple[Query, SE3 | None, int]]
"""A function that returns the input of a localization: a query, a start pose or None, and the seed of the search."""


@dataclass(eq=False)
class ShownJob:
    """A localization and its state, which the page polls."""

    id: str
    name: str
    state: Literal["waiting", "searching", "rendering", "done"] = "waiting"
    record: SearchRecord | None = None
    answer: JsonObject | None = None
    task: asyncio.Task[None] = field(init=False)

    def plain(self, known: str) -> dict[str, Any]:
        """Return the state as JSON values, and the answer unless the client already knows it for this state (``known``)."""
        state = {
            "id": self.id,
            "name": self.name,
            "state": self.state,
            "caption": self.record.steps[-1].caption if self.record is not None and self.record.steps else "",
        }
        return state if self.state == known else state | {"answer": to_plain(self.answer)}

    def run(self, localizer: Localizer, read: Read) -> None:
        """Localize the query that ``read`` returns, and store the answer; if localization fails, the answer states the error."""
        self.state = "searching"
        try:
            query, start, seed = read()
            self.answer = answer_query(localizer, query, start, seed, self._follow)
        except Cancelled:
            self.answer = no_answer(self.name, "stopped", "the viewer was closed")
        except InputError as error:
            self.answer = no_answer(self.name, BAD_INPUT, str(error))
        except Exception:  # third-party code may raise anything, with paths of this machine in it
            viewer_log.exception("internal error while localizing %s", self.name)
            self.answer = no_answer(
                self.name, "fault", "the viewer failed; its log names the cause, beside the name of the image"
            )
        finally:
            self.state = "done"

    def _follow(self, record: SearchRecord, answer: JsonObject | None) -> None:
        self.record, self.answer, self.state = record, answer, "rendering" if answer else "searching"


class Jobs:
    """The localizations of a viewer, which one thread performs in turn; ``shown`` holds them by id."""

    def __init__(self, localizer: Localizer) -> None:
        self.shown = dict[str, ShownJob]()
        self.queue = RequestQueue[ThreadExecutor](SLOTS, lambda: 5)
        self._localizer, self._thread = localizer, ThreadExecutor("localizing")
        self.queue.add(self._thread)

    def start(self, name: str, read: Read, slot: contextlib.ExitStack) -> ShownJob:
        """Localize the query that ``read`` returns in the background, and leave the ``slot`` of the queue afterwards."""
        done = [job.id for job in self.shown.values() if job.state == "done"]
        for old in done[:-MOST_ANSWERS]:
            del self.shown[old]
        job = ShownJob(uuid.uuid4().hex, name)
        self.shown[job.id] = job
        job.task = asyncio.create_task(self._run(job, read, slot))
        return job

    async def _run(self, job: ShownJob, read: Read, slot: contextlib.ExitStack) -> None:
        with slot:
            async with self.queue.executor() as thread:
                await thread.run(lambda: job.run(self._localizer, read))

    def close(self) -> None:
        """Cancel the localizations that are at work or waiting."""
        for job in self.shown.values():
            job.task.cancel()
        self._thread.close()


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


def viewer_app(live: LiveView, token: str | None = None, limits: ServiceLimits | None = None) -> Application:
    """Return the viewer as an ASGI application; ``limits`` apply to uploads.

    Without a ``token``, only requests addressed to localhost are answered.
    """
    limits = limits or ServiceLimits()
    scene, source = single_map(live.localizer), live.source
    names = () if source is None else tuple(source.names)
    usual = replace(live.camera or CameraSource(), assumed=live.localizer.assumed_cameras)
    others = replace(usual, hfov=None)  # the page sends the field of view
    state = MapView(
        map_json(scene, thumbnails=0),
        live=True,
        queries=names,
        trajectory=live.trajectory,
        results=live.results,
        hfov=usual.hfov,
        camera_given=others.is_given,
    )
    jobs, painter = Jobs(live.localizer), ThreadExecutor("rendering")

    @contextlib.asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        try:
            yield
        finally:
            jobs.close()
            painter.close()

    app = Application(
        "bidnerf view",
        token,
        "bidnerf_token",
        lifespan=lifespan,
        description="A map, and localizations in it.",
    )

    @app.get("/", response_class=HTMLResponse, summary="The page.")
    async def page() -> Response:
        # The page states a policy for its own scripts.
        headers = {"Content-Security-Policy": "frame-ancestors 'none'", "Referrer-Policy": "no-referrer"}
        return HTMLResponse(state.html(), headers=headers)

    @app.get(OPEN, summary="Whether the viewer is up; needs no token.")
    async def health() -> Response:
        return JSONResponse({"status": "ok"})

    @app.get("/api/thumbnail/{number}", responses=error_responses(404), summary="A rendering from a camera of the map.")
    async def map_image(number: str) -> Response:
        cameras = scene.info.cameras
        camera = cameras[_index(number, len(cameras), "camera of the map")]
        return Response(
            await painter.run(lambda: jpeg(thumbnail(scene, camera))),
            headers={"Cache-Control": "private, max-age=3600"},
            media_type="image/jpeg",
        )

    @app.post(
        "/api/photo",
        status_code=202,
        openapi_extra=photo_request("map"),
        responses=error_responses(400, 408, 413, 429, 503),
        summary="Queue the localization of a photo.",
    )
    async def photo(request: Request) -> Response:
        with contextlib.ExitStack() as slot:
            slot.enter_context(jobs.queue.slot())
            upload = await read_photo(request, limits)
            if "map" in upload.parameters:
                raise InputError("map is given", expected="none, since the viewer shows one map")

            def read() -> tuple[Query, SE3 | None, int]:
                with tempfile.TemporaryDirectory(prefix="bidnerf-view-") as folder:
                    try:
                        photos, start = read_upload(upload, others, Path(folder), limits.max_pixels)
                        query = photos.read(0)
                    except InputError as error:
                        raise InputError(public_message(error, Path(folder))) from error
                return (
                    Query(upload.name, tuple(view.over(scene.bounds.background) for view in query.views), query.truth),
                    start,
                    upload.seed,
                )

            return JSONResponse({"job": jobs.start(upload.name, read, slot.pop_all()).id}, 202)

    @app.post(
        "/api/query/{number}",
        status_code=202,
        responses=error_responses(404, 429),
        summary="Queue the localization of an image with which the viewer was started.",
    )
    async def query(number: str) -> Response:
        index = _index(number, len(names), "image with which the viewer was started")
        assert source is not None
        slot = contextlib.ExitStack()
        slot.enter_context(jobs.queue.slot())
        return JSONResponse({"job": jobs.start(names[index], lambda: (source.read(index), None, 0), slot).id}, 202)

    @app.get("/api/job/{id}", responses=error_responses(404), summary="The state of a localization, and its answer.")
    async def job(id: str, known: str = "") -> Response:
        if id not in jobs.shown:
            raise Refused(404, "no such localization")
        return JSONResponse(jobs.shown[id].plain(known))

    @app.post(
        "/api/view",
        openapi_extra=json_request(VirtualCamera),
        responses=error_responses(400, 408, 413, 503),
        summary="A rendering from a virtual camera.",
    )
    async def view(request: Request) -> Response:
        body = parse_json(await read_body(request, replace(limits, max_megabytes=0.1)), "", "a camera")
        camera = validate(VirtualCamera, body)
        intrinsics, T, render = camera.intrinsics, camera.T_world_camera, quick_image if camera.quick else field_image
        return Response(
            await await_result(request, asyncio.create_task(painter.run(lambda: jpeg(render(scene, intrinsics, T))))),
            media_type="image/jpeg",
        )

    return app


def _index(text: str, count: int, what: str) -> int:
    """Parse an index in a URL, so that no request can name a file. Raises ``Refused`` unless the index is less than ``count``."""
    if not re.fullmatch("[0-9]{1,9}", text) or int(text) >= count:
        raise Refused(404, f"no {what} has that number, expected less than {count}")
    return int(text)
