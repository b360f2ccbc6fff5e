"""Faults of the camera: wrong calibrations, the shutter, the orientation, exposure, optics and compression."""

from __future__ import annotations

import io
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from kornia.color import rgb_to_grayscale
from kornia.filters import gaussian_blur2d
from PIL import Image
from torch import Generator, Tensor

from bidnerf_core.camera import Intrinsics, Orientation, exposure_times, poses_of_rows
from bidnerf_core.evaluation.faults.fault import Change, random_direction, random_units
from bidnerf_core.frames import Frame


def restated(frame: Frame, **changes: Any) -> Frame:
    """Change the stated camera; the image is unchanged."""
    return frame.replace(intrinsics=replace(frame.intrinsics, **changes))


def nominal(frame: Frame, on: float, generator: Generator) -> Frame:
    """Reduce the stated camera to an approximate focal length, as for an uncalibrated photo; the image is unchanged."""
    camera = frame.intrinsics
    stated = Intrinsics.from_focal(math.sqrt(camera.fx * camera.fy), camera.width, camera.height)
    return frame.replace(intrinsics=stated, focal_is_approximate=True)


def cropped(frame: Frame, share: float, generator: Generator) -> Frame:
    """Crop away a ``share`` of the width and height at a random corner; the stated principal point ignores the crop.

    Its stated offset from the centre of the cropped image equals its true offset from the centre of the whole
    image.
    """
    camera = frame.intrinsics
    parts = []
    for size, at_end in zip(
        (camera.width, camera.height), torch.rand(2, generator=generator) < 0.5, strict=True
    ):
        cut = min(round(share * size), size - 1)
        parts.append(slice(0, size - cut) if at_end else slice(cut, size))
    columns, rows = parts
    width, height = columns.stop - columns.start, rows.stop - rows.start
    cx, cy = camera.cx - (camera.width - width) / 2, camera.cy - (camera.height - height) / 2
    stated = replace(camera, cx=cx, cy=cy, width=width, height=height)
    return _of_images(frame, lambda image: image[rows, columns].contiguous(), intrinsics=stated)


def principal_point_moved(frame: Frame, pixels: float, generator: Generator) -> Frame:
    """Move the stated principal point by ``pixels`` in a random direction; the image is unchanged."""
    camera, (across, down) = frame.intrinsics, random_direction(generator)
    return restated(frame, cx=camera.cx + pixels * across, cy=camera.cy + pixels * down)


def distorted(frame: Frame, k1: float, generator: Generator) -> Frame:
    """Distort the image with a lens whose first radial coefficient is larger by ``k1``.

    The stated intrinsics are unchanged.
    """
    camera = frame.intrinsics
    own = camera.distortion or (0.0, 0.0, 0.0, 0.0)
    lens = replace(camera, distortion=(own[0] + k1, *own[1:]))
    return warped(frame, camera.project(_rays(lens)))


def rolling_shutter(frame: Frame, degrees: float, generator: Generator) -> Frame:
    """Simulate a rolling shutter while the camera rotates by ``degrees`` about a random axis through its centre.

    The rows are those of the sensor, which are the columns of a portrait image. The middle one is exposed at
    the frame's pose. A camera that only rotates sees the same points, so no depth is needed.
    """
    camera = frame.intrinsics
    axis = random_units(1, generator)[0] * math.radians(degrees)
    times = exposure_times(camera.pixel_centres(torch.float64).reshape(-1, 2), camera)
    turns = poses_of_rows(times, torch.cat([torch.zeros_like(axis), axis]))
    seen = turns.rotate(_rays(camera).reshape(-1, 3)).reshape(camera.height, camera.width, 3)
    pixels = camera.project(seen).nan_to_num(-1.0)
    turned = warped(frame, pixels)
    if frame.depth is None:
        return turned
    # Along a row's ray (x, y, 1), a point's depth is its z in the frame's camera divided by the ray's z in
    # that camera.
    return turned.replace(depth=(nearest(frame.depth, pixels) / seen[..., 2]).float())


def turned(*, columns: bool = False, rows: bool = False) -> Change:
    """Return the fault that reverses columns, rows or both, as with a camera held upside down.

    If only columns or only rows are reversed, no camera pose gives such an image of the scene.
    """
    orientation = Orientation(mirrors_columns=columns, mirrors_rows=rows)

    def turn(frame: Frame, on: float, generator: Generator) -> Frame:
        return _of_images(frame, orientation.upright, intrinsics=frame.intrinsics.upright(orientation))

    return turn


def covered_lens(frame: Frame, on: float, generator: Generator) -> Frame:
    """Replace the image by one random colour, and remove any measured depth."""
    colour = torch.rand(3, generator=generator).to(frame.rgb)
    depth = None if frame.depth is None else torch.zeros_like(frame.depth)
    alpha = None if frame.alpha is None else torch.ones_like(frame.alpha)
    return replace(frame, rgb=colour.expand_as(frame.rgb).clone(), depth=depth, alpha=alpha)


def _rays(camera: Intrinsics) -> Float[Tensor, "h w 3"]:
    return camera.unproject(camera.pixel_centres(torch.float64))


def _of_images(frame: Frame, change: Callable[[Tensor], Tensor], **more: Any) -> Frame:
    """Return the frame with ``change`` applied to colours, depth, alpha and hidden pixels; ``more`` sets other attributes."""
    for name in ("rgb", "depth", "alpha", "hidden"):
        image = getattr(frame, name)
        more[name] = None if image is None else change(image)
    return replace(frame, **more)


# Colours, as they are stored, in [0, 1].


def recoloured(frame: Frame, rgb: Float[Tensor, "h w 3"]) -> Frame:
    """Return the frame with other colours; values brighter than white are clipped."""
    return replace(frame, rgb=rgb.clamp(0, 1))


def blur(frame: Frame, pixels: float, generator: Generator) -> Frame:
    """Blur the colours with a Gaussian whose standard deviation is ``pixels``. Depth stays sharp."""
    smallest = min(frame.rgb.shape[:2])
    # Padding by reflection at the border cannot be wider than the image.
    size = min(2 * max(1, round(3 * pixels)) + 1, smallest - 1 + smallest % 2)
    images = frame.rgb.permute(2, 0, 1)[None]
    return recoloured(frame, gaussian_blur2d(images, (size, size), (pixels, pixels))[0].permute(1, 2, 0))


def jpeg(frame: Frame, quality: float, generator: Generator) -> Frame:
    """Compress the colours as JPEG of ``quality`` 1 to 100, and decode them."""
    file = io.BytesIO()
    Image.fromarray((frame.rgb * 255).round().to(torch.uint8).numpy()).save(
        file, "JPEG", quality=int(quality)
    )
    return recoloured(frame, torch.from_numpy(np.array(Image.open(file))).to(frame.rgb) / 255)


def grey(frame: Frame, share: float, generator: Generator) -> Frame:
    """Remove ``share`` of the colours' saturation: 1 leaves only their brightness."""
    brightness = rgb_to_grayscale(frame.rgb.permute(2, 0, 1)).permute(1, 2, 0)
    return recoloured(frame, frame.rgb + share * (brightness - frame.rgb))


def vignetting(frame: Frame, share: float, generator: Generator) -> Frame:
    """Darken the image with the square of the distance from its centre, the corners by ``share``."""
    camera = frame.intrinsics
    middle = frame.rgb.new_tensor([camera.width / 2, camera.height / 2])
    radius = (camera.pixel_centres() - middle).norm(dim=-1, keepdim=True) / middle.norm()
    return recoloured(frame, frame.rgb * (1 - share * radius.square()))


# Resampling.


def warped(frame: Frame, pixels: Float[Tensor, "h w 2"]) -> Frame:
    """Return the frame whose pixel (v, u) shows what ``frame`` shows at ``pixels[v, u]``, given as (u, v).

    Colour and alpha are interpolated, with border values replicated beyond the border. Depth is that of the
    nearest pixel, since a mean across an edge lies on neither surface; it is 0 beyond the border.
    """
    alpha = None if frame.alpha is None else _interpolated(frame.alpha[..., None], pixels)[..., 0]
    depth = None if frame.depth is None else nearest(frame.depth, pixels)
    hidden = None if frame.hidden is None else nearest(frame.hidden.float(), pixels) > 0
    rgb = _interpolated(frame.rgb, pixels).clamp(0, 1)
    return replace(frame, rgb=rgb, alpha=alpha, depth=depth, hidden=hidden)


def reflected(pixels: Float[Tensor, "*p 2"], width: int, height: int) -> Float[Tensor, "*p 2"]:
    """Return pixels (u, v) mapped into an image: those beyond a border are reflected at it."""
    size = pixels.new_tensor([width, height])
    folded = pixels.remainder(2 * size)
    return torch.minimum(folded, 2 * size - folded)


def nearest(image: Float[Tensor, "h w"], pixels: Float[Tensor, "*p 2"]) -> Float[Tensor, "*p"]:
    """Return the values of the pixels that contain the positions ``pixels``, and 0 beyond the border."""
    height, width = image.shape
    column, row = pixels.floor().long().unbind(-1)
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    values = image[row.clamp(0, height - 1), column.clamp(0, width - 1)]
    return torch.where(inside, values, torch.zeros_like(values))


def _interpolated(image: Float[Tensor, "h w c"], pixels: Float[Tensor, "h w 2"]) -> Float[Tensor, "h w c"]:
    height, width = image.shape[:2]
    size = torch.tensor([width, height], dtype=torch.float64)
    grid = (pixels.double() * 2 / size - 1).to(image.dtype)
    moved = torch.nn.functional.grid_sample(
        image.permute(2, 0, 1)[None], grid[None], mode="bilinear", padding_mode="border", align_corners=False
    )
    return moved[0].permute(1, 2, 0)
