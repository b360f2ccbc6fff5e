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

ROLL = math.sin(math.radians(6.0)) ** 2
"""Variance (of the sine) of the roll of hand-held cameras relative to the horizon."""
INDEPENDENT = 8
"""Largest number of cameras whose rolls count as independent, since many frames of a video share one."""
ALIKE_DEG = 8.0
"""Angle within which normals belong to one plane or to parallel ones."""
CHANCE = 1 - math.cos(math.radians(ALIKE_DEG))
"""Fraction of randomly oriented surfels whose normals agree with a direction."""
DIRECTIONS = 1500
"""Number of directions tried."""


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
    unit = normalize(torch.tensor(tuple(direction), dtype=torch.float64), dim=0)
    return UpDirection((*unit.tolist(),), "gravity")


def up_direction(poses: SE3, normals: Float[Tensor, "n 3"] | None = None) -> UpDirection:
    """Estimate the upward direction of a scene from its cameras and, if there is a surface, its surfels' normals.

    ``poses`` are T_world_camera of the images (n), at least one; the signs of normals are ignored.
    """
    rotations = poses.rotation.detach().cpu().double()
    planes = _planes(normals)
    weight = min(len(rotations), INDEPENDENT)
    tried = list[tuple[float, Tensor, UpSource]]()
    # Log odds against sideways images, which phones store if they are held upright, mostly with the camera at the top.
    for up_axis, level_axis, prior in (
        (-rotations[:, :, 1], rotations[:, :, 0], 0.0),
        (-rotations[:, :, 0], rotations[:, :, 1], -2.0),
        (rotations[:, :, 0], rotations[:, :, 1], -3.0),
    ):
        for direction, support, source in [*planes, (_level(up_axis, level_axis), 0.0, "cameras")]:
            direction = direction if float((up_axis @ direction).mean()) >= 0 else -direction
            looking_up = max(0.0, float((rotations[:, :, 2] @ direction).mean()))
            tilt = (level_axis @ direction).square().mean() / ROLL
            score = prior + math.log(CHANCE + support) - 0.5 * weight * float(tilt)
            # Cameras rarely all look straight up; the log odds against it are proportional to the sine of the angle.
            tried.append((score - 3 * looking_up, direction, source))
    _, up, source = max(tried, key=lambda one: one[0])
    near = [(share, axis) for axis, share, _ in planes if abs(float(axis @ up)) > 1 - CHANCE]
    if source == "cameras" and near:  # snapped to the normal of a plane that is nearly perpendicular to it
        axis = max(near, key=lambda one: one[0])[1]
        up, source = axis * torch.sign(axis @ up), "planes"
    return UpDirection((*up.tolist(),), source)


def _level(up_axis: Float[Tensor, "v 3"], level_axis: Float[Tensor, "v 3"]) -> Float[Tensor, "3"]:
    """Return the direction most nearly perpendicular to all horizontal image axes, nearest to the mean upward axis.

    If all cameras face the same way, only the plane of such directions is known, and the one nearest to the mean is
    chosen; the deviation of the tilt is about 20 degrees.
    """
    mean = normalize(up_axis.mean(0), dim=0)
    spread = level_axis.mT @ level_axis / len(level_axis)
    prior = (torch.eye(3, dtype=torch.float64) - torch.outer(mean, mean)) / 0.35**2
    return torch.linalg.eigh(min(len(up_axis), INDEPENDENT) * spread / ROLL + prior)[1][:, 0]


def _planes(normals: Float[Tensor, "n 3"] | None) -> list[tuple[Tensor, float, UpSource]]:
    """Return up to six directions with which most normals agree, and the fraction of normals, beyond chance, that do."""
    if normals is None or not len(normals):
        return []
    some = normals.detach().cpu().double()[:: max(1, len(normals) // 20_000)]
    number = torch.arange(DIRECTIONS, dtype=torch.float64) + 0.5  # a Fibonacci lattice on the half sphere
    down, around = torch.acos(1 - number / DIRECTIONS), math.pi * (1 + math.sqrt(5)) * number
    tried = torch.stack([around.cos() * down.sin(), around.sin() * down.sin(), down.cos()], dim=-1)
    share = ((some.float() @ tried.float().mT).abs() > 1 - CHANCE).double().mean(0)
    found = list[tuple[Tensor, float, UpSource]]()
    for _ in range(6):
        start = axis = tried[int(share.argmax())]
        # Refined to the mean of the normals near it, in ever smaller cones.
        for degrees in (ALIKE_DEG, ALIKE_DEG, ALIKE_DEG / 2, ALIKE_DEG / 4):
            along = some @ axis
            near = along.abs() > math.cos(math.radians(degrees))
            if not bool(near.any()):
                break
            axis = normalize((some[near] * torch.sign(along[near])[:, None]).sum(0), dim=0)
        support = float(((some @ axis).abs() > 1 - CHANCE).double().mean()) - CHANCE
        if support >= 3 * CHANCE:
            found.append((axis, support, "planes"))
        share[(tried @ start).abs() > math.cos(2 * math.radians(ALIKE_DEG))] = 0
    return found
