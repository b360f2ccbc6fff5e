"""``Localizer``: prepares a map once, then localizes frames in it; and the picture of an answer in a notebook."""

from __future__ import annotations

import base64
import functools
import weakref
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from numbers import Integral
from operator import length_hint
from pathlib import Path
from threading import Event
from typing import Any

import numpy as np
import PIL.Image
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from bidnerf_core.camera import CameraSource, Intrinsics, Raster
from bidnerf_core.depth import UNKNOWN_SENSOR, DepthSensorModel, find_depth_sensor, likely_unit
from bidnerf_core.devices import constant, set_threads_here, threads_at_most, wait_for
from bidnerf_core.errors import InputError
from bidnerf_core.fields import Observations, device_of, has_field, render, render_picture
from bidnerf_core.frames import Frame, View, photos_in
from bidnerf_core.geometry import SE3, pose_from_matrix
from bidnerf_core.io import LARGEST_INTEGER, png_bytes
from bidnerf_core.localization import (
    USUAL_METHOD,
    Evidence,
    LandmarkMatcher,
    Localization,
    Outcome,
    Problem,
    SceneMap,
    Verdict,
    find_method,
    require_fit,
    rig,
    settings_of,
    shows_shape,
)
from bidnerf_core.mapping import trace
from bidnerf_core.maps.map import Map, load_map
from bidnerf_core.maps.scene import landmark_cameras, move_map_to, origin_of, unit_of
from bidnerf_core.progress import counter, current_job, job_context

NO_DISTANCES = "the map's photos are from one place and show no distances"
Start = SE3 | Localization | Float[Tensor, "4 4"] | np.ndarray | Sequence[Sequence[float]]
"""A pose T_world_camera: an ``SE3``, an answer, or a 4x4 matrix as a tensor, an array or rows of numbers."""
PixelArray = np.ndarray | Tensor | PIL.Image.Image
"""An image in memory without its camera: (h, w) or (h, w, 1 to 4), see ``Frame.from_numpy``."""
Localizable = Frame | View | Sequence[View] | PixelArray | str | Path
"""A frame, a photo by its path or its pixels (whose camera is then assumed to be the map's), a view, or a rig of views."""


class Localizer:
    """Localizes frames in one map by one method.

    The map, the method and its settings are checked once, on construction. A localizer keeps no state between calls, so threads may
    share one; the same seed gives the same answer on the same machine.
    """

    def __init__(
        self,
        scene: SceneMap | str | Path,
        method: str = USUAL_METHOD,
        config: Any = None,
        device: torch.device | str | None = None,
        warm_up: bool = True,
        preset: str | None = None,
    ) -> None:
        """Prepare the map ``scene``, or the map in that folder, for ``method``.

        ``config`` holds the method's settings: an instance of their type (``METHODS[method].config_type``), or a dictionary of the settings
        that differ from the defaults or from ``preset``, the name of a set of settings (``METHODS[method].presets``). The field, the
        surface and the landmarks are used on ``device``, by default where they are; parts of the map on another device are copied. If
        ``warm_up`` is true, lazy initialization is done now rather than in the first call. Raises ``InputError`` for unsuitable arguments.
        """
        scene = scene_of(scene, "Localizer")
        self.method = method
        self.scene: SceneMap = scene if device is None else move_map_to(scene, device)
        self._method = find_method(method)
        if config is None or isinstance(config, Mapping):
            config = settings_of(method, dict(config or {}), preset=preset)
        elif not isinstance(config, self._method.config_type):
            raise InputError(
                f"method {method!r} takes a {self._method.config_type.__name__} or a dictionary, got a"
                f" {type(config).__name__}"
            )
        elif preset is not None:
            raise InputError(
                f"got both preset {preset!r} and a {type(config).__name__}",
                expected="one, or a dictionary of what differs",
            )
        self.config = config
        landmarks = self.scene.landmarks if self._method.uses_landmarks else None
        self.matcher = None if landmarks is None else LandmarkMatcher(landmarks)
        if warm_up:
            self._warm_up()

    def __repr__(self) -> str:
        """Return a one-line description of the map and the method."""
        return f"<Localizer in {self.scene!r} by {self.method}>"

    def __call__(
        self,
        query: Localizable,
        start: Start | None = None,
        depth_rays: Observations | None = None,
        seed: int = 0,
    ) -> Localization:
        """Estimate T_world_camera of a frame, or of the last of several views.

        ``query`` is a frame, the path of a photo (whose camera is taken from its EXIF data or the map), its pixels (whose camera is the
        map's), or views with known relative poses (``T_ref_camera`` in any common frame): a rig, or a window of a sequence. ``start`` is a guess at T_world_camera of the last view,
        which some methods do not need. ``depth_rays`` are distances measured by another sensor, such as a lidar, in the frame of the last
        camera; methods that use colour alone reject them. Raises ``InputError`` for a query that cannot be localized at all; a doubtful
        pose is returned with an ``outcome`` other than ``CONVERGED``.
        """
        if depth_rays is not None:
            require_fit(self.method, lambda used: used.uses_depth, "uses colour alone, got depth points; use method")
        origin = origin_of(self.scene)
        near = None if start is None else start_pose(start).translated(-origin)
        return self.answer(self.problem(query, near, depth_rays), seed)

    def answer(self, problem: Problem, seed: int = 0) -> Localization:
        """Solve a ``problem`` created by this localizer, as ``__call__`` does: the pose is in the world, and a notebook shows the answer."""
        frame, origin = problem.views[-1].frame, origin_of(self.scene)
        found = replace(self.solve(problem, seed).translated(origin), name=frame.name)
        # Every n-th pixel, at most 240 along the longer side, since each rendered pixel takes time.
        step = -(-max(frame.intrinsics.width, frame.intrinsics.height) // 240)
        photo = frame.rgb_bytes[step // 2 :: step, step // 2 :: step].contiguous()
        with suppress(TypeError):  # there is no weak reference to a map whose class has slots
            scene = weakref.ref(self.scene)
            found = replace(found, picture=functools.partial(picture_html, scene, photo, frame.intrinsics))
        return found

    def many(
        self,
        queries: Iterable[Localizable] | str | Path,
        seed: int = 0,
        workers: int | None = None,
    ) -> Iterator[Localization | InputError]:
        """Localize independent queries, each as ``__call__`` does, and yield the answers in the order of the queries.

        The ``name`` of an answer is that of its image, such as the stem of a photo's file, or else the number of the query, from 0.

        A query that cannot be localized at all yields its ``InputError`` in place of an answer. ``workers`` threads, each with its
        own stream on a GPU, localize at the same time: by default, as many as torch has threads or, on a GPU, 8.
        ``queries`` may be an iterator, from which a few queries are taken in advance, or a folder of photos. Raises ``InputError`` unless
        ``workers`` is positive, and for a folder without photos, and ``Cancelled`` if the current job is cancelled.
        """
        if isinstance(queries, str | Path):
            photos, _ = photos_in(queries)
            if not photos:
                raise InputError("contains no photos", where=queries)
            queries = photos
        device = device_of(self.scene.field)
        # Eight queries share an accelerator, which computes for some while the host detects keypoints of others.
        count = (torch.get_num_threads() if device.type == "cpu" else 8) if workers is None else workers
        if count < 1:
            raise InputError(f"workers is {workers!r}", expected="at least 1")
        return self._many(queries, _checked_seed(seed), count, device)

    def _many(
        self, queries: Iterable[Any], seed: int, workers: int, device: torch.device
    ) -> Iterator[Localization | InputError]:
        stopped, cancel = Event(), current_job().cancel
        waiting, done = deque[Future[Localization | InputError]](), 0
        total, count = length_hint(queries), counter("localizing", "images")

        def begin() -> None:
            set_threads_here(1)  # the other cores are better spent on other queries than on parts of this one
            if device.type == "cuda":
                torch.cuda.set_stream(torch.cuda.Stream(device))

        def answer(number: int, query: Any) -> Localization | InputError:
            with job_context(cancel=lambda: stopped.is_set() or (cancel is not None and cancel())):
                try:
                    found = self(query, seed=seed)
                    return replace(found, name=found.name or str(number))
                except InputError as error:
                    return error

        if device.type == "cuda":
            # A stream does not wait for work queued on another one, such as preparations at the first use of the field.
            self._warm_up()
            wait_for(device)
        with ThreadPoolExecutor(workers, "bidnerf-localizer", begin) as pool:
            try:
                for number, query in enumerate(queries):
                    waiting.append(pool.submit(answer, number, query))
                    while len(waiting) > 2 * workers or (waiting and waiting[0].done()):
                        count(done := done + 1, max(total, done))
                        yield waiting.popleft().result()
                for future in waiting:
                    count(done := done + 1, max(total, done))
                    yield future.result()
            finally:
                stopped.set()
                pool.shutdown(cancel_futures=True)

    def problem(
        self,
        query: Localizable,
        start: Start | None = None,
        depth_rays: Observations | None = None,
    ) -> Problem:
        """Return the problem that ``__call__`` solves; solving it several times detects the images' keypoints only once.

        Unlike in ``__call__``, ``start`` is in the map's own coordinates (see ``Map.origin``), and so is the answer of ``solve``.
        """
        T_world_camera = None if start is None else start_pose(start)
        if isinstance(query, str | Path):
            query = Frame.read(query, CameraSource(assumed=self.assumed_cameras))
        query = frame_of_pixels(query, self.assumed_cameras)
        views = [view.over(self.scene.bounds.background) for view in _views(query)]
        problem = rig(self.scene, views, T_world_camera, depth_rays, self.matcher)
        # Landmarks alone are used, where there are some, while training is unfinished: rendering would cost much and add little.
        is_unfinished = isinstance(self.scene, Map) and self.scene.info.interruption is not None
        return replace(problem, colour_noise=1.0) if is_unfinished and problem.matcher is not None else problem

    def solve(self, problem: Problem, seed: int = 0) -> Localization:
        """Solve a ``problem`` created by this localizer; the pose is in the map's own coordinates.

        Raises ``InputError`` if the seed is unsuitable, if the method needs a start and there is none, or if it does not return a
        ``Localization``.
        """
        if self._method.needs_start and problem.start is None:
            raise InputError(f"method {self.method!r} needs a start; give one, or use a method that needs none")
        # On a CPU, operators are so short that sharing each of them among threads takes longer, and far longer on a busy machine.
        # Four threads suffice for the host of a GPU, which has little to compute.
        with threads_at_most(1 if problem.device.type == "cpu" else 4):
            found = self._method.solve(problem, self.config, _checked_seed(seed))
        if not isinstance(found, Localization):
            raise InputError(f"method {self.method!r} returned a {type(found).__name__}", expected="a Localization")
        found = replace(found, reason=found.reason + describe_unused_depth(problem, found), unit=unit_of(self.scene))
        if self.scene.has_distances:
            return found
        outcome = Outcome.IMPRECISE if found.converged else found.outcome
        why = f"{NO_DISTANCES}, so the position is unknown and only the direction may be right"
        return replace(found.rejected(Verdict(outcome, why)), covariance=None)

    @property
    def depth_sensor(self) -> DepthSensorModel:
        """The noise model of the depth sensor; the generic model if the method has no such setting."""
        return find_depth_sensor(getattr(self.config, "depth_sensor", UNKNOWN_SENSOR))

    @property
    def assumed_cameras(self) -> tuple[Intrinsics, ...]:
        """The cameras of the map's images, assumed for photos without a focal length; empty if landmarks are not matched."""
        return landmark_cameras(self.scene) if self.matches_landmarks else ()

    @property
    def matches_landmarks(self) -> bool:
        """Whether the map has landmarks and the method, with its settings, matches them."""
        return self.matcher is not None and getattr(self.config, "landmarks", True)

    @torch.no_grad()
    def _warm_up(self) -> None:
        """Render some rays and fill the caches of the surface, so that lazy initialisation does not delay the first call."""
        bounds, field = self.scene.bounds, self.scene.field
        directions = torch.eye(3, device=device_of(field))
        if has_field(field):
            origins = constant(bounds.centre, directions) - directions * bounds.near
            render(field, bounds.rays(origins, directions), bounds.background)
        if self.scene.surface is not None:
            self.scene.surface.warm_up()


def describe_unused_depth(problem: Problem, found: Localization) -> str:
    """Return a clause on measured depth that contradicts an accepted pose by landmarks and was left out, with the unit that would fit.

    It is empty if there is no such depth.
    """
    frame, surface = problem.views[-1].frame, problem.surface
    is_used = not isinstance(found.diagnostics, Evidence) or found.diagnostics.on_surface is not None
    if is_used or not found.converged or surface is None or frame.depth is None or not shows_shape(frame):
        return ""
    depth = frame.depth.cpu()
    pixels = (depth > 0).nonzero()
    pixels = pixels[:: 1 + len(pixels) // 500]
    rays, length = frame.intrinsics.rays(pixels.flip(-1) + 0.5)
    T = found.T_world_camera.to(surface.device, torch.float32)
    directions = rays.to(surface.device) @ T.rotation.mT
    seen = trace(surface, T.translation.expand_as(directions), directions).cpu()
    ratios = seen / (depth[tuple(pixels.mT)] * length)  # infinite beside the surface
    factor = float(ratios.median())
    clause = ", without depth: it disagrees with the map"
    # Most of the points have to agree on a factor; on another scene, or on something in front of it, they do not.
    if float(((ratios / factor - 1).abs() < 0.1).float().mean()) < 0.5:
        return clause
    clause += f", which is {factor:.3g} times as far"
    return clause + (f": is the depth unit {likely_unit(factor * frame.depth_unit):.3g} m?" if frame.depth_unit else "")


def scene_of(given: object, where: str) -> SceneMap:
    """Return the map ``given``, or the map in the folder ``given``. Raises ``InputError``, prefixed with ``where``, for anything else."""
    if isinstance(given, str | Path):
        return load_map(given)
    if isinstance(given, SceneMap):
        return given
    raise InputError(f"got a {type(given).__name__}", where=where, expected="a Map, or the folder of one")


def _checked_seed(seed: Any) -> int:
    if isinstance(seed, bool) or not isinstance(seed, Integral) or not 0 <= int(seed) <= LARGEST_INTEGER:
        raise InputError(f"seed is {seed!r}", expected="a whole number from 0 to 2**63 - 1")
    return int(seed)


def _views(query: Any) -> list[View]:
    views: list[Any] = (
        [query] if isinstance(query, Frame | View) else list(query) if isinstance(query, Sequence) else [None]
    )
    if len(views) == 1 and isinstance(views[0], Frame):
        views = [View(views[0], SE3.identity())]
    if all(isinstance(view, View) for view in views):
        return views
    if any(isinstance(view, Frame) for view in views):
        raise InputError(f"{len(views)} frames without relative poses", expected="views: View(frame, T_ref_camera)")
    raise InputError(
        f"query is a {type(query).__name__}",
        expected="the file of a photo, its pixels as an array, a Frame, a View, or a list of views",
    )


def frame_of_pixels(query: Any, cameras: Sequence[Intrinsics]) -> Any:
    """Return an image in memory (``PixelArray``) as a frame, whose camera is assumed to be one of ``cameras``; anything else unchanged."""
    pixels = np.asarray(query) if isinstance(query, PIL.Image.Image) else query
    if not isinstance(pixels, np.ndarray | Tensor) or pixels.ndim not in (2, 3):
        return query
    found = CameraSource(assumed=tuple(cameras)).find("image", Raster(pixels.shape[1], pixels.shape[0]))
    about = {"camera_source": found.description, "focal_is_approximate": found.approximate}
    return Frame.from_numpy(pixels, found.intrinsics).replace(name="", **about)


def start_pose(start: Start, what: str = "start") -> SE3:
    """Convert a pose in any form (see ``Start``) to a rigid transform in float64, on the CPU.

    Raises ``InputError``, prefixed with ``what``, for anything that is not a single pose.
    """
    if isinstance(start, Localization):
        start = start.T_world_camera
    if isinstance(start, SE3):
        shapes = tuple(start.rotation.shape), tuple(start.translation.shape)
        if shapes != ((3, 3), (3,)):
            raise InputError(
                f"{what} has a rotation and a translation of shapes {shapes[0]} and {shapes[1]}",
                expected="one pose: (3, 3) and (3)",
            )
        return SE3(start.rotation.detach(), start.translation.detach()).to("cpu", torch.float64)
    if isinstance(start, torch.Tensor):
        start = start.detach().cpu()
    try:
        matrix = torch.as_tensor(np.asarray(start, dtype=np.float64))
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{what} is a {type(start).__name__}", expected="an SE3 or a 4x4 matrix") from error
    return pose_from_matrix(matrix, what)


def picture_html(
    scene_reference: Callable[[], SceneMap | None],
    photo: UInt8[Tensor, "h w 3"],
    stated: Intrinsics,
    found: Localization,
) -> str:
    """Return an HTML element with a small photo, the map rendered at the estimated pose, and a blend of both.

    Returns "" if the map no longer exists or cannot be rendered from the pose, or if there is no pose.
    """
    scene = scene_reference()
    if scene is None or not found.T_world_camera.is_finite:
        return ""
    camera = (found.intrinsics or stated).resized(photo.shape[1], photo.shape[0])
    try:
        rendered = picture_at(scene, camera, found.T_world_camera.translated(-origin_of(scene)))
    except InputError:
        return ""
    rgb = photo.cpu() / 255
    both = torch.cat([rgb, rendered, (rgb + rendered) / 2], dim=1)
    png = base64.b64encode(png_bytes((both.clamp(0, 1) * 255).round().byte().numpy())).decode()
    title = "the photo, the map at the pose found, and both blended"
    return f'<img alt="{title}" title="{title}" src="data:image/png;base64,{png}">'


def picture_at(scene: SceneMap, camera: Intrinsics, T_world_camera: SE3) -> Float[Tensor, "h w 3"]:
    """Return the map as seen by a camera (colours in [0, 1], on the CPU): the rendered field or, without a field, the landmarks as dots.

    The pose is in the map's own coordinates.
    """
    if has_field(scene.field):
        return render_picture(scene.field, camera, T_world_camera, scene.bounds).rgb.cpu()
    image = torch.ones((camera.height, camera.width, 3))
    if scene.landmarks is not None:
        local = T_world_camera.to("cpu", torch.float64).inverse().apply(scene.landmarks.positions.cpu().double())
        rows, columns, inside = camera.cells(local)
        # Green dots stand for the rendering in a map without a field.
        image[rows[inside], columns[inside]] = torch.tensor((0.0, 0.75, 0.43))
    return image
