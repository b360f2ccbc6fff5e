"""Faults of the depth sensor. Depth is planar z in metres, and 0 where nothing was measured."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Generator, Tensor

from bidnerf_core.evaluation.faults.camera import nearest
from bidnerf_core.evaluation.faults.fault import Change, depth_of, random_direction, random_pixel
from bidnerf_core.frames import Frame


def remeasured(frame: Frame, depth: Float[Tensor, "h w"]) -> Frame:
    """Return the frame with new depth where there was a measurement; values of 0 and below count as not measured."""
    valid = (depth_of(frame) > 0) & (depth > 0)
    return frame.replace(depth=torch.where(valid, depth, torch.zeros_like(depth)))


def noisy(power: int) -> Change:
    """Return the fault that adds independent Gaussian noise of standard deviation ``size * depth ** power``.

    A power of 2 is typical of triangulating sensors.
    """

    def add(frame: Frame, size: float, generator: Generator) -> Frame:
        depth = depth_of(frame)
        noise = torch.randn(depth.shape, generator=generator, dtype=depth.dtype)
        return remeasured(frame, depth + size * depth**power * noise)

    return add


def random_holes(frame: Frame, share: float, generator: Generator) -> Frame:
    """Remove the depth of each pixel with probability ``share``, independently."""
    return _kept(frame, torch.rand(depth_of(frame).shape, generator=generator) >= share)


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
    rows, columns = _around_a_pixel(frame, int(pixels), generator)
    return _kept(frame, rows[:, None] & columns)


def few_rows(frame: Frame, count: float, generator: Generator) -> Frame:
    """Keep only the depth of ``count`` adjacent rows around a random measured pixel, as from a line scanner."""
    rows, columns = _around_a_pixel(frame, int(count), generator)
    return _kept(frame, rows[:, None].expand(-1, len(columns)))


def one_wall(frame: Frame, on: float, generator: Generator) -> Frame:
    """Keep only the depth of the plane that contains the most measured points."""
    depth = depth_of(frame)
    points = frame.intrinsics.unproject(frame.intrinsics.pixel_centres()) * depth[..., None]
    plane = _largest_plane(points[depth > 0], generator)
    return _kept(frame, _on_plane(points, plane))


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
    """Return which points are no farther from a plane than a hundredth of their depth."""
    return (points @ plane[:3] + plane[3]).abs() <= 0.01 * points[..., 2]


def _around_a_pixel(frame: Frame, size: int, generator: Generator) -> list[Bool[Tensor, "n"]]:
    """Return masks of ``size`` adjacent rows and of columns, centred on a random measured pixel as far as borders allow."""
    found = []
    for middle, length in zip(
        random_pixel(depth_of(frame) > 0, generator), depth_of(frame).shape, strict=True
    ):
        first = max(0, min(middle - size // 2, length - size))
        places = torch.arange(length)
        found.append((places >= first) & (places < first + size))
    return found


def _kept(frame: Frame, kept: Bool[Tensor, "h w"]) -> Frame:
    depth = depth_of(frame)
    return frame.replace(depth=torch.where(kept, depth, torch.zeros_like(depth)))
