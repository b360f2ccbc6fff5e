"""Baking the surface and landmarks of a map, and checking that photos show the scene of the map."""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from dataclasses import replace

import torch

from bidnerf_core.captures import (
    pose_updates,
    tried_landmarks,
)
from bidnerf_core.errors import InputError
from bidnerf_core.fields import RadianceField
from bidnerf_core.frames import View
from bidnerf_core.mapping import (
    BakeConfig,
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
from bidnerf_core.progress import counter

log = logging.getLogger("bidnerf")


def bake_surface(
    info: MapInfo, field: RadianceField, views: Sequence[View], config: BakeConfig, where: str
) -> SurfaceMap:
    """Build the surface of a map from the measured depth of ``views``, or else from depth rendered by ``field``.

    Depth is rendered from the map's cameras or, if the map has none, from the cameras of the views. Raises
    ``InputError`` if there are no cameras at all, and if the images do not agree on a surface. ``where``
    prefixes log messages.
    """
    began = time.monotonic()
    cameras = cameras_of(info) or [(view.frame.intrinsics, view.T_ref_camera) for view in views]
    if not cameras:
        raise _no_cameras(where)
    measured = [view for view in views if view.frame.has_depth]
    if not any(view.frame.has_dense_depth for view in measured):
        measured = []  # a few points do not make a surface
    surface = bake(field, info.bounds, [] if measured else cameras, measured, config)
    source = f"{len(measured)} measured" if measured else f"{len(cameras)} rendered"
    log.info(
        f"{where}: surface of {len(surface.surfels)} surfels from {source} views, {time.monotonic() - began:.1f} s"
    )
    return surface


def bake_landmarks(
    info: MapInfo,
    field: RadianceField,
    views: Sequence[View],
    where: str,
    tracked: TrackedViews | None = None,
) -> tuple[MapInfo, LandmarkMap | None, TrackedViews]:
    """Build landmarks from ``views`` or, without views, from images that ``field`` renders at the map's cameras.

    Returns the description of the map updated with the landmarks' source and detector, the landmarks, and the
    keypoints from which they were built. The landmarks are None if the images show too little texture;
    localization then relies on the surface alone. ``tracked`` holds the keypoints if already tracked. ``where``
    prefixes log messages.
    """
    began = time.monotonic()
    source: LandmarkSource = "photos" if views else "rendered images"
    images = views or rendered_views(field, info.bounds, cameras_of(info))
    if not images:
        raise _no_cameras(where)
    if tracked is None:
        tracked = tracked_views(images, info.landmark_features)
    if views and not info.distances:
        tracked = tracked.at_distance(info.bounds.side / 2)  # the directions are still informative
    landmarks = None
    counter("trying the landmarks on images", "stage")(0, 1)
    try:
        landmarks = tried_landmarks(tracked, images, report=log.info)
    except InputError as error:
        log.info(f"{where}: no landmarks: {error}")
    else:
        # New poses are compared with others from the same source as the given ones. If training kept those,
        # except for some wrong ones, their errors are negligible.
        by_source = update_scatter(pose_updates(info.cameras))
        landmarks = replace(landmarks, pose_covariance=landmarks.pose_covariance + by_source)
        if views:
            landmarks = with_tracks_in(info, landmarks, [view.frame.name for view in views])
        else:
            landmarks = replace(landmarks, tracks=None)  # in rendered images, which are not stored
        info = replace(info, landmark_source=source, landmark_features=landmarks.features)
        log.info(
            f"{where}: {len(landmarks)} landmarks ({landmarks.megabytes:.1f} MB) from {len(images)} {source},"
            f" {time.monotonic() - began:.1f} s"
        )
    return info, landmarks, tracked


def _no_cameras(where: str) -> InputError:
    return InputError("holds no cameras to render from; give a dataset of its views with --data", where=where)


def with_tracks_in(info: MapInfo, landmarks: LandmarkMap, names: Sequence[str]) -> LandmarkMap:
    """Return landmarks built from images with these ``names``, with tracks that refer to the images of the map."""
    if landmarks.tracks is None:
        return landmarks
    numbers = {camera.name: number for number, camera in enumerate(info.cameras)}
    images = torch.tensor([numbers.get(name, -1) for name in names])
    return replace(landmarks, tracks=landmarks.tracks.renumbered(images=images))


def check_alike(info: MapInfo, field: RadianceField, views: Sequence[View], where: str) -> None:
    """Raise ``InputError`` if photos differ too much from the field's renderings, whether or not the map was built from them."""
    # The difference (RMS) between rendered and photographed colours indicates another scene if it is large relative to that of
    # the photos the map was built from, or in itself if that is unknown, as in a map that was never baked.
    off, usual = colour_noise(field, info.bounds, views), info.colour_noise
    if off > (0.3 if usual is None else max(0.2, 2 * usual)):
        raise InputError(
            f"built from {info.data or 'other views'!r}, and its renderings differ from the photos by"
            f" {off:.0%} of the range of colours;",
            where=where,
            expected="photos of the same scene, with poses in the coordinates of the map",
        )
