"""Arcs of images around an object: frames of a split that are a given angle apart (BID-NeRF, Table 2)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.geometry import SE3, turned_about


def seen_middle(poses: Sequence[SE3]) -> Float[Tensor, "3"]:
    """Return the least-squares intersection of all optical axes (metres, world): the point the surrounding
    cameras look at.
    """
    eye = torch.eye(3, dtype=torch.float64)
    across = [eye - torch.outer(T.rotation[:, 2], T.rotation[:, 2]) for T in poses]
    normal = torch.stack(across).sum(0) + 1e-9 * eye  # for parallel axes, any point will do
    return torch.linalg.solve(
        normal, torch.stack([A @ T.translation for A, T in zip(across, poses, strict=True)]).sum(0)
    )


def mean_up(poses: Sequence[SE3]) -> Float[Tensor, "3"]:
    """Return the mean upward direction of the images (unit, world)."""
    mean = -torch.stack([T.rotation[:, 1] for T in poses]).mean(0)
    return torch.nn.functional.normalize(mean if mean.norm() > 1e-3 else -poses[0].rotation[:, 1], dim=0)


def arc(poses: Sequence[SE3], last: int, count: int, angle_deg: float) -> tuple[int, ...] | None:
    """Return the indices of ``count`` frames, ``angle_deg`` apart about their common centre, ending with
    ``last``.

    At each step about the vertical axis, the frame nearest in direction from the centre is chosen. Both
    senses of rotation are tried, and the better fit is returned; None if at some step no unused frame lies
    within half a step.
    """
    middle, up = seen_middle(poses), mean_up(poses)
    directions = torch.nn.functional.normalize(torch.stack([T.translation - middle for T in poses]), dim=-1)
    tries = [_one_way(poses, directions, last, middle, up, count, way * angle_deg) for way in (1, -1)]
    fitting = [found for found in tries if found is not None]
    return min(fitting)[1] if fitting else None


def _one_way(
    poses: Sequence[SE3], directions: Tensor, last: int, middle: Tensor, up: Tensor, count: int, angle: float
) -> tuple[float, tuple[int, ...]] | None:
    """Return the mean angle (rad) between frames and their ideal places, and the frames' indices; None if one
    is missing.
    """
    taken, missed = [last], 0.0
    for step in range(1, count):
        wanted = turned_about(poses[last], middle, up, step * angle).translation - middle
        cosines = directions @ torch.nn.functional.normalize(wanted, dim=0)
        cosines[taken] = -1
        best = int(cosines.argmax())
        off = math.acos(min(1.0, float(cosines[best])))
        if off > math.radians(abs(angle)) / 2:
            return None
        taken.append(best)
        missed += off / count
    return missed, tuple(reversed(taken))
