"""``bidnerf bake``."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import torch

from bidnerf_core.captures.advice import summary
from bidnerf_core.captures.cameras import at_stored_poses, stored_cameras
from bidnerf_core.captures.survey import surveyed
from bidnerf_core.captures.trial import tried_landmarks
from bidnerf_core.cli.camera_options import DatasetCamera, RegisterDepth, depth_registration
from bidnerf_core.cli.opened_map import unfinished
from bidnerf_core.cli.options import Device, Flag, MapFolder, option, parse
from bidnerf_core.cli.output import read_views, say
from bidnerf_core.cli.progress import counted
from bidnerf_core.datasets import open_dataset
from bidnerf_core.devices import working_device
from bidnerf_core.errors import InputError, UsageError
from bidnerf_core.frames.frame import View
from bidnerf_core.io.files import locked
from bidnerf_core.mapping import BakeConfig, bake
from bidnerf_core.mapping.keyframes import Camera, colour_noise, rendered_views
from bidnerf_core.mapping.landmark_building import TrackedViews, tracked_views
from bidnerf_core.mapping.landmarks import HeldOutTrial
from bidnerf_core.mapping.pose_scatter import update_scatter
from bidnerf_core.maps.description import LandmarkSource, MapInfo, cameras_of, load_info
from bidnerf_core.maps.files import load_landmarks, save_capture, save_landmarks, save_surface
from bidnerf_core.maps.map import Map, load_map

UNLIKE, UNLIKE_ITS_OWN, UNLIKE_ANY = 0.2, 2.0, 0.3
"""Least difference (RMS) between rendered and photographed colours in another scene: as such, and as a multiple of that between
the field and the photos that the map was made of; and where the latter is not known, as in a map that was never baked."""


def run(arguments: list[str]) -> None:
    """Parse and bake."""
    parse("bake", _bake, arguments)


def _bake(
    map: MapFolder,
    data: Annotated[
        Path | None,
        option(
            "DATA",
            "dataset whose photos give landmarks and whose measured depth gives the surface",
            "rendered images only",
        ),
    ] = None,
    split: Annotated[str, option("NAME", "split of the dataset")] = "train",
    camera: DatasetCamera = None,
    register_depth: RegisterDepth = None,
    rendered_landmarks: Annotated[
        Flag, option(None, "replace landmarks of photos by landmarks of rendered images", "")
    ] = False,
    device: Device = "cpu",
    config: BakeConfig = BakeConfig(),
) -> None:
    """Find the surface and the landmarks of a map, and store them in the map.

    Depth is rendered from where the training images were taken; what several of these views agree on is kept. With
    --data, views with measured depth are taken as they are instead, and landmarks are built from the photos; without it
    they are built from images that the field renders, which are as sharp as the field. Landmarks of photos are kept
    unless --data gives new photos or --rendered-landmarks asks for others.
    """
    if rendered_landmarks and data is not None:
        raise UsageError("--rendered-landmarks takes no photos, but --data gives some; expected one of them")
    info, registration, there = load_info(map), depth_registration(register_depth), working_device(device)
    with locked(map):
        views = list[View]()
        if data is not None:
            dataset = open_dataset(data, info.bounds.background, camera=camera, register_depth=registration)
            views = at_stored_poses(read_views(dataset, split), info.cameras)
            _check_scene(map, data, views, there)
        bake_map(map, views, config, rendered_landmarks, device=there)


def _check_scene(folder: Path, data: Path, views: Sequence[View], device: torch.device) -> None:
    """Raise ``InputError`` for photos of another scene: none of those that the map was made of, and unlike its field."""
    stored = load_map(folder, device, baked=False)
    own = {(camera.name, camera.T_world_camera) for camera in stored.info.cameras}
    known = any((c.name, c.T_world_camera) in own for c in stored_cameras(views))
    if known or not own:
        return
    off, usual = colour_noise(stored.field, stored.bounds, views), stored.colour_noise
    if off > (UNLIKE_ANY if usual is None else max(UNLIKE, UNLIKE_ITS_OWN * usual)):
        raise InputError(
            f"{folder}: made from {stored.info.data!r}, and its renderings differ from the photos of {data} by {off:.0%} of the"
            " range of colours; expected photos of the same scene, with poses in the coordinates of the map"
        )


def bake_map(
    folder: Path, views: Sequence[View], config: BakeConfig, rendered_landmarks: bool = False,
    tracked: TrackedViews | None = None, device: torch.device | str = "cpu",
) -> None:  # fmt: skip
    """Bake the surface and the landmarks of the map in ``folder``.

    For the surface, views with measured depth replace rendered ones; landmarks are built from all ``views``. ``tracked`` holds
    the views' keypoints if they were tracked already. Without views, landmarks are built from images that the field renders,
    unless the map has landmarks of photos: these are kept unless ``rendered_landmarks`` is set. Images are rendered on
    ``device``.
    """
    stored = load_map(folder, device, baked=False)  # its baked parts may be damaged, and are replaced anyway
    if (stopped := unfinished(folder)) is not None:
        say(f"{folder}: {stopped}")
    places = [(view.frame.intrinsics, view.T_ref_camera) for view in views]
    cameras = cameras_of(stored.info) or places
    if not cameras:
        raise InputError(
            f"{folder}: holds no cameras to render it from; give a dataset of its views by --data"
        )
    _bake_surface(folder, stored, views, cameras, config)
    if not views and not rendered_landmarks and _has_photo_landmarks(folder, stored.info):
        say(f"{folder}: the landmarks of its photos are kept; --rendered-landmarks replaces them")
        return
    # Only photos show how well the field renders; against its own images it has no error.
    noise = colour_noise(stored.field, stored.bounds, views) if views else stored.colour_noise
    source: LandmarkSource = "photos" if views else "rendered images"
    images = views or rendered_views(stored.field, stored.bounds, cameras)
    _bake_landmarks(folder, stored, images, noise, source, tracked)


def _has_photo_landmarks(folder: Path, info: MapInfo) -> bool:
    """Return whether the map has landmarks that were built from photos, in a file that is not damaged."""
    if info.landmarks is None or info.landmark_source == "rendered images":
        return False
    try:
        load_landmarks(folder / info.landmarks)
    except InputError as error:
        say(str(error))
        return False
    return True


def _bake_surface(
    folder: Path, stored: Map, views: Sequence[View], cameras: Sequence[Camera], config: BakeConfig
) -> None:
    began = time.monotonic()
    measured = [view for view in views if view.frame.has_depth]
    if not any(view.frame.has_dense_depth for view in measured):
        measured = []  # a few points do not make a surface
    cameras = [] if measured else cameras
    with counted("baking", "views") as report:
        surface = bake(stored.field, stored.bounds, cameras, measured, config, report)
    save_surface(folder, stored.info, surface)
    source = f"{len(measured)} measured" if measured else f"{len(cameras)} rendered"
    say(
        f"{folder}: surface of {len(surface.surfels)} surfels from {source} views, {time.monotonic() - began:.1f} s"
    )
    size = f"{surface.stored_cells} cells with a side of {surface.cell:.3g}, {surface.mebibytes:.1f} MiB"
    say(f"{folder}: the surface is indexed by {size}")


def _bake_landmarks(
    folder: Path, stored: Map, views: Sequence[View], noise: float | None, source: LandmarkSource,
    tracked: TrackedViews | None,
) -> None:  # fmt: skip
    """Build landmarks from the views and, if these are photos, store the record of their capture.

    A scene without texture has no landmarks; localization then relies on the surface alone.
    """
    began = time.monotonic()
    if tracked is None:
        with counted("landmarks", "steps") as report:
            tracked = tracked_views(views, progress=report)
    if source == "photos" and not stored.info.distances:
        tracked = tracked.at_distance(stored.bounds.side / 2)  # the directions are still informative
    trial = HeldOutTrial()
    try:
        landmarks = tried_landmarks(tracked, views, report=say)
    except InputError as error:
        say(f"{folder}: no landmarks: {error}")
    else:
        trial = landmarks.trial
        # New poses are compared with others from the source of the given ones. If training kept those, except for some wrong
        # ones, their errors are negligible.
        by_source = update_scatter([camera.update for camera in stored.info.cameras])
        landmarks = replace(landmarks, pose_covariance=landmarks.pose_covariance + by_source)
        save_landmarks(folder, stored.info, landmarks, noise, source)
        say(
            f"{folder}: {len(landmarks)} landmarks ({landmarks.megabytes:.1f} MB) from {len(views)} {source},"
            f" {time.monotonic() - began:.1f} s"
        )
    if source == "photos":
        _record_capture(folder, stored.info, tracked, views, trial)


def _record_capture(
    folder: Path, info: MapInfo, tracked: TrackedViews, views: Sequence[View], trial: HeldOutTrial
) -> None:
    """Store the record of the capture, and print a summary of it."""
    capture = surveyed(tracked, views, trial=trial)
    save_capture(folder, info, capture)
    for line in summary(capture):
        say(line)
