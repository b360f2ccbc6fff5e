"""Camera trajectories around and within a scene. World axes: z up; camera axes are OpenCV's (z forward, y down)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

from bidnerf_core.fields import SceneBounds
from bidnerf_core.geometry import SE3, look_at

GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))
"""Angle (rad) whose successive multiples fill a circle evenly, however many there are."""


def orbit(
    radius: float,
    count: int,
    centre: Sequence[float] = (0.0, 0.0, 0.0),
    elevation: tuple[float, float] = (5.0, 80.0),
    seed: int = 0,
) -> list[SE3]:
    """Return poses (``T_world_camera``) spread evenly over a sphere (Fibonacci) around ``centre``, which they look at.

    ``radius`` is in metres. ``elevation`` is the range in degrees above the horizon; (-90, 90) is the whole sphere. ``seed``
    rotates the spiral, so that two seeds have no position in common.
    """
    turn, shift = torch.rand(2, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).tolist()
    low, high = (math.sin(math.radians(e)) for e in elevation)
    poses: list[SE3] = []
    for i in range(count):
        z = low + (high - low) * (i + shift) / count
        azimuth, flat = i * GOLDEN_ANGLE + 2 * math.pi * turn, math.sqrt(max(0.0, 1 - z * z))
        offset = (flat * math.cos(azimuth), flat * math.sin(azimuth), z)
        poses.append(look_at([c + radius * o for c, o in zip(centre, offset, strict=True)], centre))
    return poses


def look_around(bounds: SceneBounds, count: int, seed: int = 0, spread: float = 0.5) -> list[SE3]:
    """Return poses (``T_world_camera``) in a room, at head height, in all compass directions, tilted slightly
    up or down.

    Each camera stands about ``spread`` of the way from the middle of the room to the wall behind it, to see
    much of the room.
    """
    generator = torch.Generator().manual_seed(seed)
    lower, upper = (torch.tensor(corner, dtype=torch.float64) for corner in (bounds.lower, bounds.upper))
    middle, half = (lower + upper) / 2, (upper - lower) / 2
    poses: list[SE3] = []
    turn = 2 * math.pi * torch.rand((), generator=generator, dtype=torch.float64).item()
    for chance in torch.rand((count, 4), generator=generator, dtype=torch.float64):
        azimuth = turn + len(poses) * GOLDEN_ANGLE
        forward = middle.new_tensor([math.cos(azimuth), math.sin(azimuth), 0.0])
        sideways = (chance[:3] - 0.5) * middle.new_tensor([0.4, 0.4, 0.3])
        eye = middle + half * (sideways - spread * forward + middle.new_tensor([0.0, 0.0, 0.15]))
        tilt = middle.new_tensor([0.0, 0.0, 0.15 - 0.6 * chance[3].item()])
        poses.append(look_at(eye, eye + forward + tilt))
    return poses
