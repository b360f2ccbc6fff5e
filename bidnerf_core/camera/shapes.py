"""A map's cameras, adapted to images of another size: portrait instead of landscape, cropped, or stretched."""

from __future__ import annotations

from functools import lru_cache

from bidnerf_core.camera.intrinsics import Intrinsics, same_aspect

CameraGroup = tuple[Intrinsics, ...]
"""Cameras that were all turned to the same side, if they were turned at all."""


@lru_cache(maxsize=64)
def cameras_at_size(cameras: CameraGroup, width: int, height: int) -> tuple[CameraGroup, ...]:
    """Return the ``cameras`` whose images have the aspect ratio of another size, resized to it.

    If there are none, those whose images have it after a quarter turn are returned, in two groups: turned to one side, and to
    the other. Empty if there are none of these either.
    """
    size = (width, height)
    same = tuple(c.resized(*size) for c in cameras if same_aspect((c.width, c.height), size))
    if same:
        return (same,)
    turned = [c.quarter_turns() for c in cameras if same_aspect((c.height, c.width), size)]
    sides = zip(*filter(None, turned), strict=True)
    return tuple(tuple(camera.resized(*size) for camera in side) for side in sides)


@lru_cache(maxsize=64)
def centre_crop_cameras(cameras: CameraGroup, width: int, height: int) -> tuple[CameraGroup, ...]:
    """Return all ``cameras``, cropped about the centre to the aspect ratio of another size and resized to it.

    Landscape cameras are turned to either side for a portrait size, and vice versa.
    """
    size = (width, height)
    return tuple(tuple(c.centre_crop(*size) for c in group) for group in _oriented(cameras, *size))


@lru_cache(maxsize=64)
def stretched_cameras(cameras: CameraGroup, width: int, height: int) -> tuple[CameraGroup, ...]:
    """Return all ``cameras``, resized to another size whatever their aspect ratio.

    Landscape cameras are turned to either side for a portrait size, and vice versa.
    """
    return tuple(
        tuple(dict.fromkeys(camera.resized(width, height) for camera in group))
        for group in _oriented(cameras, width, height)
    )


def median_camera(group: CameraGroup) -> Intrinsics:
    """Return the camera with the median focal length, the lower of the two middle ones."""
    return sorted(group, key=lambda camera: camera.fx)[(len(group) - 1) // 2]


def _oriented(cameras: CameraGroup, width: int, height: int) -> tuple[CameraGroup, ...]:
    """Return the cameras turned to landscape or portrait like another size: one group, or two if any had to be turned."""
    ways = [
        (camera,) if (camera.width - camera.height) * (width - height) >= 0 else camera.quarter_turns()
        for camera in cameras
    ]
    ways = [way for way in ways if way]
    sides = max(map(len, ways), default=0)
    return tuple(tuple(way[side % len(way)] for way in ways) for side in range(sides))
