"""Captures of the landmark scene whose given poses are off by known updates, by cameras that may have moved."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from bidnerf import SE3, View

# Inside: the refinement of poses is tested without a training around it
from bidnerf_core.captures import TrainingPoses
from bidnerf_core.captures.training_views import training_poses
from bidnerf_core.mapping import track_views
from landmark_scene import Points, looking_in

VIEWS = 16


def updates(metres: float, radians: float, seed: int) -> Tensor:
    """Normally distributed updates of all poses, with these deviations."""
    size = torch.tensor([metres] * 3 + [radians] * 3, dtype=torch.float64)
    return size * torch.randn(VIEWS, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def capture(noise: float, off: Tensor, moved: Tensor | None = None) -> tuple[Points, list[View], SE3]:
    """Views of a ring of cameras, named by numbers, whose given poses are off by right updates, and the true poses."""
    points = Points(150, noise)
    poses = SE3.stack([looking_in(0.105 * i, 0.3 * (i % 3)) for i in range(VIEWS)])
    given, motions = poses.retract(off), [None] * VIEWS if moved is None else moved
    views = [points.view(poses[i], T_ref_camera=given[i], seed=i, motion=motions[i]) for i in range(VIEWS)]
    return points, [replace(v, frame=replace(v.frame, name=f"{i}")) for i, v in enumerate(views)], poses


def refined(
    noise: float, off: Tensor, moved: Tensor | None = None, least: float = 0.25
) -> tuple[TrainingPoses, list[View], SE3]:
    points, views, poses = capture(noise, off, moved)
    return training_poses(track_views(views, points), views, least), views, poses


def turned(T: SE3, true: SE3) -> Tensor:
    """The error (radians) of each rotation relative to the one before, which no common rotation changes."""
    steps = [x[:-1].inverse() @ x[1:] for x in (T, true)]
    return (steps[1].inverse() @ steps[0]).log()[:, 3:].norm(dim=-1)
