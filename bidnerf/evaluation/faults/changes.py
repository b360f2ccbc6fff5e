"""The changes that the bundled faults make to depth, to the stated camera, to the image and to the scene.

Depth is planar z in metres, and 0 where nothing was measured.
"""

from __future__ import annotations

import io
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from kornia.color import rgb_to_grayscale
from kornia.filters import gaussian_blur2d
from PIL import Image
from scipy.ndimage import binary_dilation
from torch import Generator, Tensor

from bidnerf.evaluation.faults.fault import depth_of
from bidnerf_core.camera import Intrinsics, Orientation, exposure_times, poses_of_rows
from bidnerf_core.frames import Frame
from bidnerf_core.geometry import random_units

# Random choices.


def random_direction(generator: Generator) -> tuple[float, float]:
    """Return a uniformly distributed unit vector in the image plane."""
    angle = 2 * math.pi * uniform_number(generator)
    return math.cos(angle), math.sin(angle)


def uniform_number(generator: Generator, low: float = 0.0, high: float = 1.0) -> float:
    """Return a uniformly distributed number between two limits."""
    return low + (high - low) * float(torch.rand((), generator=generator, dtype=torch.float64))


def random_pixel(mask: Bool[Tensor, "h w"], generator: Generator) -> tuple[int, int]:
    """Return the row and column of a random pixel of ``mask``, which marks at least one."""
    pixels = mask.nonzero()
    row, column = pixels[int(torch.randint(len(pixels), (), generator=generator))].tolist()
    return row, column


# Depth.


def replace_depth(frame: Frame, depth: Float[Tensor, "h w"]) -> Frame:
    """Return the frame with new depth where there was a measurement; values of 0 and below count as not measured."""
    valid = (depth_of(frame) > 0) & (depth > 0)
    return frame.replace(depth=torch.where(valid, depth, torch.zeros_like(depth)))


def add_noise(frame: Frame, size: float, generator: Generator, power: int = 1) -> Frame:
    """Add independent Gaussian noise of standard deviation ``size * depth ** power``; power 2 is typical of triangulating sensors."""
    depth = depth_of(frame)
    noise = torch.randn(depth.shape, generator=generator, dtype=depth.dtype)
    return replace_depth(frame, depth + size * depth**power * noise)


def keep_depth(frame: Frame, mask: Bool[Tensor, "h w"]) -> Frame:
    """Return the frame with depth only at the pixels marked in ``mask``."""
    return frame.replace(depth=depth_of(frame).where(mask, 0))


def remove_random_depth(frame: Frame, share: float, generator: Generator) -> Frame:
    """Remove the depth of each pixel with probability ``share``, independently."""
    return keep_depth(frame, torch.rand(depth_of(frame).shape, generator=generator) >= share)


def remove_depth_on_one_side(frame: Frame, share: float, generator: Generator) -> Frame:
    """Remove ``share`` of the measured pixels in one piece: all that lie on one side of a line of random direction."""
    depth = depth_of(frame)
    across, down = random_direction(generator)
    rows, columns = torch.meshgrid(*map(torch.arange, depth.shape), indexing="ij")
    along = across * columns + down * rows
    order = along[depth > 0].sort().values
    removed = round(share * len(order))
    return frame if removed == 0 else keep_depth(frame, along > order[removed - 1])


def misregister(frame: Frame, pixels: float, generator: Generator) -> Frame:
    """Shift the depth by ``pixels`` relative to the colour image, in a random direction."""
    depth = depth_of(frame)
    move = depth.new_tensor(random_direction(generator)) * pixels
    return frame.replace(depth=nearest(depth, frame.intrinsics.pixel_centres() - move))


def keep_window(frame: Frame, size: float, generator: Generator, whole_rows: bool = False) -> Frame:
    """Keep only the depth inside a square of ``size`` by ``size`` pixels around a random measured pixel.

    With ``whole_rows``, keep the depth of ``size`` adjacent rows instead, as from a line scanner. The window lies inside
    the image as far as possible.
    """
    depth, masks = depth_of(frame), []
    for middle, length in zip(random_pixel(depth > 0, generator), depth.shape, strict=True):
        first = max(0, min(middle - int(size) // 2, length - int(size)))
        indices = torch.arange(length)
        masks.append((indices >= first) & (indices < first + int(size)))
    rows, columns = masks
    return keep_depth(frame, rows[:, None] & (columns | whole_rows))


def keep_largest_plane(frame: Frame, on: float, generator: Generator) -> Frame:
    """Keep only the depth of the plane that contains the most measured points."""
    depth = depth_of(frame)
    points = frame.intrinsics.unproject(frame.intrinsics.pixel_centres()) * depth[..., None]
    plane = _largest_plane(points[depth > 0], generator)
    return keep_depth(frame, _on_plane(points, plane))


def _largest_plane(points: Float[Tensor, "n 3"], generator: Generator) -> Float[Tensor, "4"]:
    """Return the plane (unit normal, offset) that contains the most points, found by random sampling.

    256 planes through three random points each are compared on a sample of the points.
    """
    corners = points[torch.randint(len(points), (256, 3), generator=generator)]
    sample = points[torch.randint(len(points), (4096,), generator=generator)]
    crossed = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = torch.nn.functional.normalize(crossed, dim=-1)
    planes = torch.cat([normals, -(normals * corners[:, 0]).sum(-1, keepdim=True)], dim=-1)
    planes = planes[crossed.norm(dim=-1) > 0]
    if len(planes) == 0:  # all points are collinear: any plane through them contains them all
        return points.new_zeros(4)
    counts = torch.stack([_on_plane(sample, plane).sum() for plane in planes])
    return planes[counts.argmax()]


def _on_plane(points: Float[Tensor, "*p 3"], plane: Float[Tensor, "4"]) -> Bool[Tensor, "*p"]:
    """Return a mask of the points whose distance from a plane is at most a hundredth of their depth."""
    return (points @ plane[:3] + plane[3]).abs() <= 0.01 * points[..., 2]


# The stated camera, and what the image shows of it.


def restate_camera(frame: Frame, **changes: Any) -> Frame:
    """Change parameters of the stated camera; the image is unchanged."""
    return frame.replace(intrinsics=replace(frame.intrinsics, **changes))


def state_focal_alone(frame: Frame, on: float, generator: Generator) -> Frame:
    """Reduce the stated camera to an approximate focal length, as for an uncalibrated photo; the image is unchanged."""
    camera = frame.intrinsics
    stated = Intrinsics.from_focal(math.sqrt(camera.fx * camera.fy), camera.width, camera.height)
    return frame.replace(intrinsics=stated, focal_is_approximate=True)


def crop(frame: Frame, share: float, generator: Generator) -> Frame:
    """Crop away a ``share`` of the width and height at a random corner; the stated principal point ignores the crop.

    The stated offset of the principal point from the centre of the cropped image equals its true offset from
    the centre of the whole image.
    """
    camera = frame.intrinsics
    parts = []
    for size, at_end in zip((camera.width, camera.height), torch.rand(2, generator=generator) < 0.5, strict=True):
        cut = min(round(share * size), size - 1)
        parts.append(slice(0, size - cut) if at_end else slice(cut, size))
    columns, rows = parts
    width, height = columns.stop - columns.start, rows.stop - rows.start
    cx, cy = camera.cx - (camera.width - width) / 2, camera.cy - (camera.height - height) / 2
    stated = replace(camera, cx=cx, cy=cy, width=width, height=height)
    return _of_images(frame, lambda image: image[rows, columns].contiguous(), intrinsics=stated)


def move_principal_point(frame: Frame, pixels: float, generator: Generator) -> Frame:
    """Move the stated principal point by ``pixels`` in a random direction; the image is unchanged."""
    camera, (across, down) = frame.intrinsics, random_direction(generator)
    return restate_camera(frame, cx=camera.cx + pixels * across, cy=camera.cy + pixels * down)


def distort(frame: Frame, k1: float, generator: Generator) -> Frame:
    """Distort the image with a lens whose first radial coefficient is larger by ``k1``.

    The stated intrinsics are unchanged.
    """
    camera = frame.intrinsics
    own = camera.distortion or (0.0, 0.0, 0.0, 0.0)
    lens = replace(camera, distortion=(own[0] + k1, *own[1:]))
    return warp(frame, camera.project(_rays(lens)))


def rolling_shutter(frame: Frame, degrees: float, generator: Generator) -> Frame:
    """Simulate a rolling shutter while the camera rotates by ``degrees`` about a random axis through its centre.

    The rows are those of the sensor, which are the columns of a portrait image. The middle row is exposed at
    the frame's pose. A camera that only rotates sees the same points, so no depth is needed.
    """
    camera = frame.intrinsics
    axis = random_units(1, generator)[0] * math.radians(degrees)
    times = exposure_times(camera.pixel_centres(torch.float64).reshape(-1, 2), camera)
    turns = poses_of_rows(times, torch.cat([torch.zeros_like(axis), axis]))
    seen = turns.rotate(_rays(camera).reshape(-1, 3)).reshape(camera.height, camera.width, 3)
    pixels = camera.project(seen).nan_to_num(-1.0)
    image = warp(frame, pixels)
    if frame.depth is None:
        return image
    # Along a row's ray (x, y, 1), a point's depth is its z in the frame's camera divided by the ray's z in
    # that camera.
    return image.replace(depth=(nearest(frame.depth, pixels) / seen[..., 2]).float())


def flip(frame: Frame, on: float, generator: Generator, columns: bool = False, rows: bool = False) -> Frame:
    """Reverse the columns, the rows, or both; with both reversed, the image is that of a camera held upside down.

    If only columns or only rows are reversed, no camera pose gives such an image of the scene.
    """
    orientation = Orientation(mirrors_columns=columns, mirrors_rows=rows)
    return _of_images(frame, orientation.upright, intrinsics=frame.intrinsics.upright(orientation))


def cover_lens(frame: Frame, on: float, generator: Generator) -> Frame:
    """Replace the image with one random colour, and remove any measured depth."""
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


def recolour(frame: Frame, rgb: Float[Tensor, "h w 3"]) -> Frame:
    """Return the frame with other colours; values brighter than white are clipped."""
    return replace(frame, rgb=rgb.clamp(0, 1))


def blur(frame: Frame, pixels: float, generator: Generator) -> Frame:
    """Blur the colours with a Gaussian whose standard deviation is ``pixels``. Depth stays sharp."""
    smallest = min(frame.rgb.shape[:2])
    # Padding by reflection at the border cannot be wider than the image.
    size = min(2 * max(1, round(3 * pixels)) + 1, smallest - 1 + smallest % 2)
    images = frame.rgb.permute(2, 0, 1)[None]
    return recolour(frame, gaussian_blur2d(images, (size, size), (pixels, pixels))[0].permute(1, 2, 0))


def compress(frame: Frame, quality: float, generator: Generator) -> Frame:
    """Compress the colours as JPEG with a ``quality`` of 1 to 100, and decode them."""
    file = io.BytesIO()
    Image.fromarray((frame.rgb * 255).round().to(torch.uint8).numpy()).save(file, "JPEG", quality=int(quality))
    return recolour(frame, torch.from_numpy(np.array(Image.open(file))).to(frame.rgb) / 255)


def desaturate(frame: Frame, share: float, generator: Generator) -> Frame:
    """Remove ``share`` of the colours' saturation: 1 leaves only their brightness."""
    brightness = rgb_to_grayscale(frame.rgb.permute(2, 0, 1)).permute(1, 2, 0)
    return recolour(frame, frame.rgb + share * (brightness - frame.rgb))


def darken_corners(frame: Frame, share: float, generator: Generator) -> Frame:
    """Darken the image in proportion to the squared distance from its centre, by ``share`` in the corners."""
    camera = frame.intrinsics
    middle = frame.rgb.new_tensor([camera.width / 2, camera.height / 2])
    radius = (camera.pixel_centres() - middle).norm(dim=-1, keepdim=True) / middle.norm()
    return recolour(frame, frame.rgb * (1 - share * radius.square()))


# Resampling.


def warp(frame: Frame, pixels: Float[Tensor, "h w 2"]) -> Frame:
    """Return the frame whose pixel (v, u) shows what ``frame`` shows at ``pixels[v, u]``, given as (u, v).

    Colour and alpha are interpolated, with border values replicated beyond the border. Depth is that of the
    nearest pixel, since a mean across an edge lies on neither surface; it is 0 beyond the border.
    """
    alpha = None if frame.alpha is None else _interpolate(frame.alpha[..., None], pixels)[..., 0]
    depth = None if frame.depth is None else nearest(frame.depth, pixels)
    hidden = None if frame.hidden is None else nearest(frame.hidden.float(), pixels) > 0
    rgb = _interpolate(frame.rgb, pixels).clamp(0, 1)
    return replace(frame, rgb=rgb, alpha=alpha, depth=depth, hidden=hidden)


def nearest(image: Float[Tensor, "h w"], pixels: Float[Tensor, "*p 2"]) -> Float[Tensor, "*p"]:
    """Return the values of the pixels that contain the positions ``pixels``, and 0 beyond the border."""
    height, width = image.shape
    column, row = pixels.floor().long().unbind(-1)
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    values = image[row.clamp(0, height - 1), column.clamp(0, width - 1)]
    return torch.where(inside, values, torch.zeros_like(values))


def _interpolate(image: Float[Tensor, "h w c"], pixels: Float[Tensor, "h w 2"]) -> Float[Tensor, "h w c"]:
    height, width = image.shape[:2]
    size = torch.tensor([width, height], dtype=torch.float64)
    grid = (pixels.double() * 2 / size - 1).to(image.dtype)
    moved = torch.nn.functional.grid_sample(
        image.permute(2, 0, 1)[None], grid[None], mode="bilinear", padding_mode="border", align_corners=False
    )
    return moved[0].permute(1, 2, 0)


# The scene: occluding objects, and objects that moved, appeared or vanished since it was mapped.

RIM = 3
"""Width, in pixels, of the surroundings from which a hole is filled."""


def add_occluder(frame: Frame, share: float, generator: Generator, is_measured: bool = True) -> Frame:
    """Put a textured object in front of ``share`` of the image.

    If the frame has depth, so does the object, unless ``is_measured`` is False, as for an object too near for
    the sensor.
    """
    height, width = frame.rgb.shape[:2]
    mask, colours = blob(height, width, share, generator), texture(height, width, generator)
    if not is_measured or frame.depth is None or not frame.has_depth:
        return _paste(frame, mask, colours, None if frame.depth is None else torch.zeros_like(frame.depth))
    # The object is nearer than the nearest part of the scene, the second percentile of its depth, with a relief of 5 %.
    near = float(np.quantile(frame.depth[frame.depth > 0].numpy(), 0.02))
    relief = 1 + 0.05 * _bounded_noise(frame, 3, generator)
    return _paste(frame, mask, colours, uniform_number(generator, 0.4, 0.8) * near * relief)


def move_piece(frame: Frame, share: float, generator: Generator) -> Frame:
    """Copy a piece of the scene, slightly nearer, to another position, where it covers ``share`` of the image.

    The features of the copy match those of the map, and consistently support a wrong pose.
    """
    height, width = frame.rgb.shape[:2]
    mask = blob(height, width, share, generator)
    # The piece moves by a fraction of the image's shorter side, and comes slightly nearer.
    travel = uniform_number(generator, 0.15, 0.3) * min(height, width)
    move = torch.tensor(random_direction(generator)) * travel
    # Pixels beyond a border of the image are reflected at it.
    size = torch.tensor([width, height])
    folded = (frame.intrinsics.pixel_centres() - move).remainder(2 * size)
    elsewhere = warp(frame, torch.minimum(folded, 2 * size - folded))
    depth = None if elsewhere.depth is None else elsewhere.depth * uniform_number(generator, 0.85, 0.98)
    return _paste(frame, mask, elsewhere.rgb, depth, elsewhere.alpha)


def add_object(frame: Frame, share: float, generator: Generator) -> Frame:
    """Put a textured object on ``share`` of the measured surface, from which it protrudes slightly."""
    mask = _mark_surface_piece(frame, share, generator)
    # The height above the surface, towards the camera, is relative to the depth.
    rise = uniform_number(generator, 0.02, 0.1) * (1 + 0.4 * _bounded_noise(frame, 6, generator))
    colours = texture(frame.intrinsics.height, frame.intrinsics.width, generator)
    return _paste(frame, mask, colours, depth_of(frame) * (1 - rise))


def remove_piece(frame: Frame, share: float, generator: Generator) -> Frame:
    """Remove ``share`` of the measured surface in one piece, and show the background or the surroundings in its place.

    If the frame has alpha and the piece reaches the edge of the scene, the background is visible; otherwise
    the surrounding colours are continued, at the depth of the farthest surrounding surface.
    """
    mask = _mark_surface_piece(frame, share, generator)
    rim = torch.from_numpy(binary_dilation(mask.numpy(), iterations=RIM)) & ~mask
    if not mask.any() or not rim.any():
        return frame
    depth = depth_of(frame)
    empty = None if frame.alpha is None else rim & (frame.alpha < 0.5)
    if empty is not None and empty.any():
        background = frame.rgb[empty].median(dim=0).values.expand_as(frame.rgb)
        return _paste(frame, mask, background, torch.zeros_like(depth), torch.zeros_like(depth))
    # The surrounding colours are continued (Telea 2004).
    colours = (frame.rgb * 255).round().to(torch.uint8).contiguous().numpy()
    filled = cv2.inpaint(colours, mask.to(torch.uint8).numpy(), RIM, cv2.INPAINT_TELEA)
    return _paste(frame, mask, torch.from_numpy(filled).to(frame.rgb) / 255, depth[rim].max().expand_as(depth))


def _mark_surface_piece(frame: Frame, share: float, generator: Generator) -> Bool[Tensor, "h w"]:
    """Mark ``share`` of the measured pixels: those whose points are nearest to a randomly chosen one."""
    depth = depth_of(frame)
    points = frame.intrinsics.unproject(frame.intrinsics.pixel_centres()) * depth[..., None]
    row, column = random_pixel(depth > 0, generator)
    distance = (points - points[row, column]).norm(dim=-1)
    order = distance.masked_fill(depth <= 0, torch.inf).flatten().argsort()
    mask = torch.zeros(depth.numel(), dtype=torch.bool)
    mask[order[: round(share * int((depth > 0).sum()))]] = True
    return mask.reshape(depth.shape)


def _bounded_noise(frame: Frame, cells: int, generator: Generator) -> Float[Tensor, "h w"]:
    camera = frame.intrinsics
    return smooth_noise(camera.height, camera.width, cells, cells, generator).clamp(-2, 2)


def _paste(
    frame: Frame,
    mask: Bool[Tensor, "h w"],
    rgb: Float[Tensor, "h w 3"],
    depth: Float[Tensor, "h w"] | None,
    alpha: Float[Tensor, "h w"] | None = None,
) -> Frame:
    """Return the frame with new colours, depth and alpha (1 by default) inside ``mask``."""
    changed = replace(frame, rgb=torch.where(mask[..., None], rgb, frame.rgb))
    if frame.depth is not None and depth is not None:
        changed = changed.replace(depth=torch.where(mask, depth.to(frame.depth), frame.depth))
    if frame.alpha is not None:
        cover = torch.ones_like(frame.alpha) if alpha is None else alpha
        changed = changed.replace(alpha=torch.where(mask, cover, frame.alpha))
    return changed


def blob(height: int, width: int, share: float, generator: Generator) -> Bool[Tensor, "h w"]:
    """Return a mask of one irregular piece around a random position that covers exactly ``share`` of the image.

    With the same generator state, a larger share covers everything that a smaller one does.
    """
    centre = uniform_number(generator, 0.2, 0.8) * width, uniform_number(generator, 0.2, 0.8) * height
    down = torch.arange(height, dtype=torch.float32)[:, None] + 0.5 - centre[1]
    across = torch.arange(width, dtype=torch.float32)[None, :] + 0.5 - centre[0]
    # The logarithm of the outline's radius is a sum of waves around the centre. Every point of the outline is visible from
    # there, so that the blob is one piece.
    angle = torch.atan2(down, across)
    waves = [
        uniform_number(generator, -0.35, 0.35) * torch.cos(n * angle + uniform_number(generator, 0, 2 * math.pi))
        for n in range(2, 6)  # number of periods around the outline
    ]
    distance = torch.hypot(down, across) / torch.stack(waves).sum(0).exp()
    covered = round(share * height * width)
    mask = torch.zeros(height * width, dtype=torch.bool)
    mask[distance.flatten().argsort()[:covered]] = True
    return mask.reshape(height, width)


def texture(height: int, width: int, generator: Generator) -> Float[Tensor, "h w 3"]:
    """Return random colours with detail at several scales and full contrast, with as many features as a photo."""
    longer = max(height, width)
    layers = []
    # From one octave of noise to the next, the number of cells along the longer side doubles.
    for octave in range(2, 8):
        rows, columns = (max(2, round(2**octave * side / longer)) for side in (height, width))
        layer = [smooth_noise(height, width, rows, columns, generator) for _ in range(3)]
        layers.append(torch.stack(layer, -1) * 2 ** (1 - octave / 2))
    noise = torch.stack(layers).sum(0)
    low, high = noise.flatten(0, 1).quantile(torch.tensor([0.02, 0.98]), dim=0)
    return ((noise - low) / (high - low).clamp_min(1e-6)).clamp(0, 1)


def smooth_noise(height: int, width: int, rows: int, columns: int, generator: Generator) -> Float[Tensor, "h w"]:
    """Return normally distributed values on a grid of ``rows`` by ``columns``, interpolated with cubic splines."""
    values = torch.randn((1, 1, rows, columns), generator=generator)
    return torch.nn.functional.interpolate(values, (height, width), mode="bicubic", align_corners=False)[0, 0]
