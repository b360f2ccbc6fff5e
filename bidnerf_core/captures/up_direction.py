"""The upward direction of a scene: from gravity if the capture measured it, else from planes and cameras.

People hold cameras level, but they look down on desks and objects, so the mean of the cameras' upward axes is
tilted as much as the cameras are. Two cues do not suffer from this: the horizontal image axes of level
cameras are perpendicular to the vertical, and floors, ceilings and tables are horizontal planes. The
direction is the one with the most support from both.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from bidnerf_core.geometry import SE3

UpSource = Literal["gravity", "planes", "cameras"]
"""Where an upward direction comes from."""

ROLL_DEG = 6.0
"""Standard deviation of the roll of hand-held cameras relative to the horizon."""
INDEPENDENT = 8
"""Largest number of cameras whose rolls count as independent, since many frames of a video share one."""
SIDEWAYS = 2.0
"""Log odds of upright against sideways images, as stored by phones that are held upright."""
LOOKING_UP = 3.0
"""Log odds against all cameras looking straight up, proportional to the sine of the angle."""
ALIKE_DEG = 8.0
"""Angle within which normals belong to one plane or to parallel ones."""
CHANCE = 1 - math.cos(math.radians(ALIKE_DEG))
"""Fraction of randomly oriented surfels whose normals agree with a direction."""
CLEAR = 3 * CHANCE
"""Smallest fraction of the surfels, beyond chance, that makes a plane."""
DIRECTIONS, SAMPLED, PLANES = 1500, 20_000, 6
"""Number of directions tried, of surfels sampled, and of candidate planes."""


@dataclass(frozen=True)
class UpDirection:
    """The upward direction of a scene, and its source."""

    direction: tuple[float, float, float]  # unit, world
    source: UpSource

    def tensor(self) -> Float[Tensor, "3"]:
        """Return the direction as a tensor (float64)."""
        return torch.tensor(self.direction, dtype=torch.float64)


def given_up(direction: Sequence[float]) -> UpDirection:
    """Return the upward direction that a capture measured; its length does not matter."""
    return _found(normalize(torch.tensor(tuple(direction), dtype=torch.float64), dim=0), "gravity")


def up_direction(poses: SE3, normals: Float[Tensor, "n 3"] | None = None) -> UpDirection:
    """Estimate the upward direction of a scene from its cameras and, if there is a surface, its surfels'
    normals.

    ``poses`` are T_world_camera of the images (n), at least one; the signs of normals are ignored.
    """
    rotations = poses.rotation.detach().cpu().double()
    planes = _planes(normals)
    best: tuple[float, Tensor, UpSource] | None = None
    for up_axis, level_axis, prior in (
        (-rotations[:, :, 1], rotations[:, :, 0], 0.0),
        (-rotations[:, :, 0], rotations[:, :, 1], -SIDEWAYS),
        (rotations[:, :, 0], rotations[:, :, 1], -SIDEWAYS - 1),  # phones have the camera at the top
    ):
        for direction, support, source in [*planes, *_level(up_axis, level_axis)]:
            direction = direction if float((up_axis @ direction).mean()) >= 0 else -direction
            looking_up = max(0.0, float((rotations[:, :, 2] @ direction).mean()))  # which is rare
            tilt = (level_axis @ direction).square().mean() / math.sin(math.radians(ROLL_DEG)) ** 2
            score = prior + math.log(CHANCE + support) - 0.5 * min(len(rotations), INDEPENDENT) * float(tilt)
            score -= LOOKING_UP * looking_up
            if best is None or score > best[0]:
                best = score, direction, source
    assert best is not None  # cameras always give a direction
    return _snapped(best[1], best[2], planes)


def _snapped(
    up: Float[Tensor, "3"], source: UpSource, planes: Sequence[tuple[Tensor, float, UpSource]]
) -> UpDirection:
    """Snap the direction to the normal of a plane that is nearly perpendicular to it."""
    if source == "cameras":
        cosine = math.cos(math.radians(ALIKE_DEG))
        near = [(share, axis) for axis, share, _ in planes if abs(float(axis @ up)) > cosine]
        if near:
            axis = max(near, key=lambda found: found[0])[1]
            return _found(axis * torch.sign(axis @ up), "planes")
    return _found(up, source)


def _level(
    up_axis: Float[Tensor, "v 3"], level_axis: Float[Tensor, "v 3"]
) -> list[tuple[Tensor, float, UpSource]]:
    """Return the direction most nearly perpendicular to all horizontal image axes, nearest to the mean upward
    axis.

    If all cameras face the same way, only the plane of such directions is known, and the one nearest to the mean is
    chosen.
    """
    mean = normalize(up_axis.mean(0), dim=0)
    spread = level_axis.mT @ level_axis / len(level_axis)
    prior = 0.1 * (
        torch.eye(3, dtype=torch.float64) - torch.outer(mean, mean)
    )  # a tilt of 20 degrees is common
    roll = math.sin(math.radians(ROLL_DEG)) ** 2
    weight = min(len(up_axis), INDEPENDENT)
    return [(torch.linalg.eigh(weight * spread / roll + prior / 0.1 / 0.35**2)[1][:, 0], 0.0, "cameras")]


def _planes(normals: Float[Tensor, "n 3"] | None) -> list[tuple[Tensor, float, UpSource]]:
    """Return the directions with which most normals agree, and the fraction of normals, beyond chance, that
    do.
    """
    if normals is None or not len(normals):
        return []
    some = normals.detach().cpu().double()[:: max(1, len(normals) // SAMPLED)]
    number = torch.arange(DIRECTIONS, dtype=torch.float64) + 0.5  # a Fibonacci lattice on the half sphere
    down, around = torch.acos(1 - number / DIRECTIONS), math.pi * (1 + math.sqrt(5)) * number
    tried = torch.stack([around.cos() * down.sin(), around.sin() * down.sin(), down.cos()], dim=-1)
    cosine = math.cos(math.radians(ALIKE_DEG))
    share = ((some.float() @ tried.float().mT).abs() > cosine).double().mean(0)
    found = list[tuple[Tensor, float, UpSource]]()
    for _ in range(PLANES):
        best = int(share.argmax())
        axis = _mean_axis(some, tried[best])
        support = float(((some @ axis).abs() > cosine).double().mean()) - CHANCE
        if support >= CLEAR:
            found.append((axis, support, "planes"))
        share[(tried @ tried[best]).abs() > math.cos(2 * math.radians(ALIKE_DEG))] = 0
    return found


def _mean_axis(normals: Float[Tensor, "n 3"], axis: Float[Tensor, "3"]) -> Float[Tensor, "3"]:
    """Return the mean direction of the normals near an axis, refined iteratively."""
    for degrees in (ALIKE_DEG, ALIKE_DEG, ALIKE_DEG / 2, ALIKE_DEG / 4):
        along = normals @ axis
        near = along.abs() > math.cos(math.radians(degrees))
        if not bool(near.any()):
            return axis
        axis = normalize((normals[near] * torch.sign(along[near])[:, None]).sum(0), dim=0)
    return axis


def _found(direction: Float[Tensor, "3"], source: UpSource) -> UpDirection:
    x, y, z = direction.tolist()
    return UpDirection((x, y, z), source)
