"""Camera faults: wrong calibrations, the shutter, and the orientation."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Generator, Tensor

from bidnerf_core.camera import Intrinsics, Orientation, exposure_times, poses_of_rows
from bidnerf_core.evaluation.faults.fault import random_direction
from bidnerf_core.evaluation.faults.warp import nearest, warped
from bidnerf_core.evaluation.protocols import random_units
from bidnerf_core.frames import Frame


def focal_scaled(frame: Frame, factor: float, generator: Generator) -> Frame:
    """Multiply the stated focal lengths by ``factor``; the image is unchanged."""
    camera = frame.intrinsics
    return frame.replace(intrinsics=replace(camera, fx=camera.fx * factor, fy=camera.fy * factor))


def nominal(frame: Frame, on: float, generator: Generator) -> Frame:
    """Reduce the stated camera to an approximate focal length, as for an uncalibrated photo; the image is unchanged."""
    if not on:
        return frame
    camera = frame.intrinsics
    stated = Intrinsics.from_focal(math.sqrt(camera.fx * camera.fy), camera.width, camera.height)
    return frame.replace(intrinsics=stated, focal_is_approximate=True)


def stretched(frame: Frame, factor: float, generator: Generator) -> Frame:
    """Multiply the stated horizontal focal length by ``factor``, as if only the image's height had been resized."""
    return frame.replace(intrinsics=replace(frame.intrinsics, fx=frame.intrinsics.fx * factor))


def cropped(frame: Frame, share: float, generator: Generator) -> Frame:
    """Crop away a ``share`` of the width and height at a random corner; the stated principal point ignores the crop.

    Its stated offset from the centre of the cropped image is its true offset from the centre of the whole
    one.
    """
    camera = frame.intrinsics
    columns, rows = (
        _kept(size, share, end)
        for size, end in zip(
            (camera.width, camera.height), torch.rand(2, generator=generator) < 0.5, strict=True
        )
    )
    width, height = columns.stop - columns.start, rows.stop - rows.start
    cx, cy = camera.cx - (camera.width - width) / 2, camera.cy - (camera.height - height) / 2
    stated = replace(camera, cx=cx, cy=cy, width=width, height=height)
    images = (frame.rgb, frame.depth, frame.alpha, frame.hidden)
    rgb, depth, alpha, hidden = (None if x is None else x[rows, columns].contiguous() for x in images)
    assert rgb is not None
    return replace(frame, rgb=rgb, depth=depth, alpha=alpha, hidden=hidden, intrinsics=stated)


def _kept(size: int, share: float, end: Tensor) -> slice:
    """Return the slice of ``size`` pixels that remains after a ``share`` is cut off at the beginning or the end."""
    cut = min(round(share * size), size - 1)
    return slice(0, size - cut) if bool(end) else slice(cut, size)


def principal_point_moved(frame: Frame, pixels: float, generator: Generator) -> Frame:
    """Move the stated principal point by ``pixels`` in a random direction; the image is unchanged."""
    camera, (across, down) = frame.intrinsics, random_direction(generator)
    wrong = replace(camera, cx=camera.cx + pixels * across, cy=camera.cy + pixels * down)
    return frame.replace(intrinsics=wrong)


def distorted(frame: Frame, k1: float, generator: Generator) -> Frame:
    """Distort the image with a lens whose first radial coefficient is larger by ``k1``, without changing the
    stated intrinsics.
    """
    camera = frame.intrinsics
    own = camera.distortion or (0.0, 0.0, 0.0, 0.0)
    lens = replace(camera, distortion=(own[0] + k1, *own[1:]))
    return warped(frame, camera.project(_rays(lens)))


def rolling_shutter(frame: Frame, degrees: float, generator: Generator) -> Frame:
    """Simulate a rolling shutter while the camera rotates by ``degrees`` about a random axis through its
    centre.

    The rows are those of the sensor, which are the columns of a portrait image. The middle one is exposed at
    the frame's pose. A camera that only rotates sees the same points, so no depth is needed.
    """
    camera = frame.intrinsics
    axis = random_units(1, generator)[0] * math.radians(degrees)
    times = exposure_times(camera.pixel_centres(torch.float64).reshape(-1, 2), camera)
    turns = poses_of_rows(times, torch.cat([torch.zeros_like(axis), axis]))
    seen = turns.rotate(_rays(camera).reshape(-1, 3)).reshape(camera.height, camera.width, 3)
    pixels = camera.project(seen)
    turned = warped(frame, pixels.nan_to_num(-1.0))
    if frame.depth is None:
        return turned
    # Along a row's ray (x, y, 1), a point's depth is its z in the frame's camera divided by the ray's z in
    # that camera.
    return turned.replace(depth=(nearest(frame.depth, pixels.nan_to_num(-1.0)) / seen[..., 2]).float())


def _rays(camera: Intrinsics) -> Float[Tensor, "h w 3"]:
    return camera.unproject(camera.pixel_centres(torch.float64))


def mirrored(frame: Frame, on: float, generator: Generator) -> Frame:
    """Swap left and right of colour and depth; the result is not a view of the scene from anywhere."""
    return _turned(frame, Orientation(mirrors_columns=True)) if on else frame


def flipped(frame: Frame, on: float, generator: Generator) -> Frame:
    """Swap top and bottom of colour and depth; the result is not a view of the scene from anywhere."""
    return _turned(frame, Orientation(mirrors_rows=True)) if on else frame


def upside_down(frame: Frame, on: float, generator: Generator) -> Frame:
    """Rotate the image by 180 degrees, as if the camera had been held upside down."""
    return _turned(frame, Orientation(mirrors_columns=True, mirrors_rows=True)) if on else frame


def covered_lens(frame: Frame, on: float, generator: Generator) -> Frame:
    """Show one random colour everywhere, without any measured depth."""
    if not on:
        return frame
    colour = torch.rand(3, generator=generator).to(frame.rgb)
    depth = None if frame.depth is None else torch.zeros_like(frame.depth)
    alpha = None if frame.alpha is None else torch.ones_like(frame.alpha)
    return replace(frame, rgb=colour.expand_as(frame.rgb).clone(), depth=depth, alpha=alpha)


def _turned(frame: Frame, orientation: Orientation) -> Frame:
    return replace(
        frame,
        rgb=orientation.upright(frame.rgb),
        depth=None if frame.depth is None else orientation.upright(frame.depth),
        alpha=None if frame.alpha is None else orientation.upright(frame.alpha),
        hidden=None if frame.hidden is None else orientation.upright(frame.hidden),
        intrinsics=frame.intrinsics.upright(orientation),
    )
