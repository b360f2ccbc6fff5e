"""Faults of the depth sensor. Depth is planar z in metres, and 0 where nothing was measured."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Generator, Tensor

from bidnerf_core.evaluation.faults.fault import depth_of, random_direction, random_pixel
from bidnerf_core.evaluation.faults.warp import nearest
from bidnerf_core.frames import Frame

PLANE_TRIALS, PLANE_SAMPLE = 256, 4096
"""Number of planes to try, and of points used to compare them."""
PLANE_TOLERANCE = 0.01
"""Maximum distance of a point from a plane that it belongs to, relative to the point's depth."""


def scaled(frame: Frame, factor: float, generator: Generator) -> Frame:
    """Multiply the depth by ``factor``."""
    return frame.replace(depth=depth_of(frame) * factor)


def offset(frame: Frame, metres: float, generator: Generator) -> Frame:
    """Add a constant to the depth."""
    return _remeasured(frame, depth_of(frame) + metres)


def proportional_noise(frame: Frame, share: float, generator: Generator) -> Frame:
    """Add independent Gaussian noise whose standard deviation is ``share`` of the depth."""
    depth = depth_of(frame)
    return _remeasured(frame, depth + share * depth * _normal(depth, generator))


def quadratic_noise(frame: Frame, per_metre: float, generator: Generator) -> Frame:
    """Add independent Gaussian noise of standard deviation ``per_metre * depth ** 2``, typical of triangulating sensors."""
    depth = depth_of(frame)
    return _remeasured(frame, depth + per_metre * depth.square() * _normal(depth, generator))


def quantised(frame: Frame, step: float, generator: Generator) -> Frame:
    """Round the depth to multiples of ``step`` (metres)."""
    depth = depth_of(frame)
    return frame if step == 0 else _remeasured(frame, (depth / step).round() * step)


def random_holes(frame: Frame, share: float, generator: Generator) -> Frame:
    """Remove the depth of each pixel with probability ``share``, independently."""
    depth = depth_of(frame)
    return _kept(frame, torch.rand(depth.shape, generator=generator) >= share)


def one_hole(frame: Frame, share: float, generator: Generator) -> Frame:
    """Remove ``share`` of the measured pixels in one piece: all that lie on one side of a line of random direction."""
    depth = depth_of(frame)
    across, down = random_direction(generator)
    rows, columns = torch.meshgrid(*map(torch.arange, depth.shape), indexing="ij")
    along = across * columns + down * rows
    order = along[depth > 0].sort().values
    removed = round(share * len(order))
    return frame if removed == 0 else _kept(frame, along > order[removed - 1])


def misregistered(frame: Frame, pixels: float, generator: Generator) -> Frame:
    """Shift the depth by ``pixels`` relative to the colour image, in a random direction."""
    depth = depth_of(frame)
    move = depth.new_tensor(random_direction(generator)) * pixels
    return frame.replace(depth=nearest(depth, frame.intrinsics.pixel_centres() - move))


def square_window(frame: Frame, pixels: float, generator: Generator) -> Frame:
    """Keep only the depth inside a square of ``pixels`` by ``pixels`` around a random measured pixel."""
    row, column = random_pixel(depth_of(frame) > 0, generator)
    height, width = depth_of(frame).shape
    rows, columns = _interval(row, height, int(pixels)), _interval(column, width, int(pixels))
    return _kept(frame, rows[:, None] & columns[None, :])


def few_rows(frame: Frame, count: float, generator: Generator) -> Frame:
    """Keep only the depth of ``count`` adjacent rows around a random measured pixel, as from a line scanner."""
    row, _ = random_pixel(depth_of(frame) > 0, generator)
    height, width = depth_of(frame).shape
    return _kept(frame, _interval(row, height, int(count))[:, None].expand(height, width))


def one_wall(frame: Frame, on: float, generator: Generator) -> Frame:
    """Keep only the depth of the plane that contains the most measured points."""
    if not on:
        return frame
    depth = depth_of(frame)
    points = frame.intrinsics.unproject(frame.intrinsics.pixel_centres()) * depth[..., None]
    plane = _largest_plane(points[depth > 0], generator)
    return _kept(frame, _on_plane(points, plane))


def _largest_plane(points: Float[Tensor, "n 3"], generator: Generator) -> Float[Tensor, "4"]:
    """Return the plane (unit normal, offset) with the most points, among random planes through three points each."""
    corners = points[torch.randint(len(points), (PLANE_TRIALS, 3), generator=generator)]
    sample = points[torch.randint(len(points), (PLANE_SAMPLE,), generator=generator)]
    crossed = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = torch.nn.functional.normalize(crossed, dim=-1)
    planes = torch.cat([normals, -(normals * corners[:, 0]).sum(-1, keepdim=True)], dim=-1)
    planes = planes[crossed.norm(dim=-1) > 0]
    if len(planes) == 0:  # all points are collinear: any plane through them contains them all
        return points.new_zeros(4)
    counts = torch.stack([_on_plane(sample, plane).sum() for plane in planes])
    return planes[counts.argmax()]


def _on_plane(points: Float[Tensor, "*p 3"], plane: Float[Tensor, "4"]) -> Bool[Tensor, "*p"]:
    return (points @ plane[:3] + plane[3]).abs() <= PLANE_TOLERANCE * points[..., 2]


def _interval(middle: int, length: int, size: int) -> Bool[Tensor, "n"]:
    """Mark ``length`` adjacent places out of ``size``, centred on ``middle`` as far as the ends allow."""
    first = max(0, min(middle - size // 2, length - size))
    places = torch.arange(length)
    return (places >= first) & (places < first + size)


def _normal(depth: Float[Tensor, "h w"], generator: Generator) -> Float[Tensor, "h w"]:
    return torch.randn(depth.shape, generator=generator, dtype=depth.dtype)


def _remeasured(frame: Frame, depth: Float[Tensor, "h w"]) -> Frame:
    """Return the frame with new depth where there was a measurement; values of 0 and below count as not measured."""
    valid = (depth_of(frame) > 0) & (depth > 0)
    return frame.replace(depth=torch.where(valid, depth, torch.zeros_like(depth)))


def _kept(frame: Frame, kept: Bool[Tensor, "h w"]) -> Frame:
    depth = depth_of(frame)
    return frame.replace(depth=torch.where(kept, depth, torch.zeros_like(depth)))
