"""Baking: the surface and landmarks of a map, and the capture record of its photos."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from bidnerf_core.captures import CaptureReport, UpDirection, pose_updates, summary, surveyed, tried_landmarks
from bidnerf_core.errors import InputError
from bidnerf_core.fields import RadianceField
from bidnerf_core.frames import View
from bidnerf_core.mapping import (
    BakeConfig,
    HeldOutTrial,
    LandmarkMap,
    SurfaceMap,
    TrackedViews,
    bake,
    colour_noise,
    rendered_views,
    tracked_views,
    update_scatter,
)
from bidnerf_core.maps.description import LandmarkSource, MapInfo, cameras_of
from bidnerf_core.progress import Cancel, ProgressCallback, counter

log = logging.getLogger("bidnerf")


@dataclass(frozen=True, eq=False)
class BakedLandmarks:
    """Landmarks, and what was learned while they were built."""

    landmarks: LandmarkMap | None  # None if the images show too little texture
    source: LandmarkSource
    colour_noise: (
        float | None
    )  # root mean square error of rendered colours on photos; None if it was not measured
    capture: CaptureReport | None  # capture record of the photos; None for rendered images


def bake_surface(
    info: MapInfo, field: RadianceField, views: Sequence[View], config: BakeConfig, where: str,
    progress: ProgressCallback | None = None, cancel: Cancel | None = None,
) -> SurfaceMap:  # fmt: skip
    """Build the surface of a map from the measured depth of ``views`` or, if there is none, from depth
    rendered by ``field``.

    Depth is rendered from the map's cameras, or from those of the views if the map has none. Raises
    ``InputError`` if there are neither, and if images do not agree on a surface. ``where`` begins log
    messages.
    """
    began = time.monotonic()
    cameras = cameras_of(info) or [(view.frame.intrinsics, view.T_ref_camera) for view in views]
    if not cameras:
        raise InputError(
            "holds no cameras to render from; give a dataset of its views with --data", where=where
        )
    measured = [view for view in views if view.frame.has_depth]
    if any(view.frame.has_dense_depth for view in measured):
        cameras = []
    else:
        measured = []  # a few points do not make a surface
    surface = bake(
        field, info.bounds, cameras, measured, config, counter("baking", "views", progress, cancel)
    )
    source = f"{len(measured)} measured" if measured else f"{len(cameras)} rendered"
    log.info(
        f"{where}: surface of {len(surface.surfels)} surfels from {source} views, {time.monotonic() - began:.1f} s"
    )
    size = f"{surface.stored_cells} cells with a side of {surface.cell:.3g}, {surface.mebibytes:.1f} MiB"
    log.info(f"{where}: the surface is indexed by {size}")
    return surface


def bake_landmarks(
    info: MapInfo, field: RadianceField, views: Sequence[View], where: str, tracked: TrackedViews | None = None,
    progress: ProgressCallback | None = None, cancel: Cancel | None = None, up: UpDirection | None = None,
) -> BakedLandmarks:  # fmt: skip
    """Build landmarks from ``views`` or, without any, from images that ``field`` renders at the map's
    cameras.

    ``tracked`` holds the views' keypoints if they were tracked already. A scene without texture has no
    landmarks; localization then relies on the surface alone. ``where`` begins log messages, and ``up`` is the
    upward direction of the scene if known.
    """
    began = time.monotonic()
    source: LandmarkSource = "photos" if views else "rendered images"
    # Only photos show how well the field renders; it has no error against its own images.
    noise = colour_noise(field, info.bounds, views) if views else info.colour_noise
    rendering = counter("rendering", "views", progress, cancel)
    images = views or rendered_views(field, info.bounds, cameras_of(info), rendering)
    report = counter("landmarks", "steps", progress, cancel)
    tracked = tracked_views(images, info.landmark_features, progress=report) if tracked is None else tracked
    if views and not info.distances:
        tracked = tracked.at_distance(info.bounds.side / 2)  # the directions are still informative
    trial, landmarks = HeldOutTrial(), None
    try:
        landmarks = _tried(info, tracked, images, log.info)
    except InputError as error:
        log.info(f"{where}: no landmarks: {error}")
    else:
        trial = landmarks.trial
        log.info(
            f"{where}: {len(landmarks)} landmarks ({landmarks.megabytes:.1f} MB) from {len(images)} {source},"
            f" {time.monotonic() - began:.1f} s"
        )
    capture = surveyed(tracked, views, trial=trial, up=up) if views else None
    for line in [] if capture is None else summary(capture):
        log.info(line)
    return BakedLandmarks(landmarks, source, noise, capture)


def _tried(
    info: MapInfo, tracked: TrackedViews, views: Sequence[View], report: Callable[[str], None]
) -> LandmarkMap:
    landmarks = tried_landmarks(tracked, views, report=report)
    # New poses are compared with others from the same source as the given ones. If training kept those,
    # except for some wrong ones, their errors are negligible.
    by_source = update_scatter(pose_updates(info.cameras))
    return replace(landmarks, pose_covariance=landmarks.pose_covariance + by_source)
