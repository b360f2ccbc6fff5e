"""Selecting the pairs of posed images that are likely to show the same part of the scene."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor

from bidnerf_core.frames.frame import View
from bidnerf_core.geometry.se3 import SE3


def likely_pairs(views: Sequence[View], neighbours: int) -> Int[Tensor, "p 2"]:
    """Return pairs (i < j) of each view with ``neighbours`` views likely to show the same things, without duplicates."""
    return likely_pairs_of_poses([view.T_ref_camera for view in views], neighbours)


def likely_pairs_of_poses(poses: Sequence[SE3], neighbours: int) -> Int[Tensor, "p 2"]:
    """Return pairs (i < j) of cameras with similar ``poses`` (T_world_camera), without duplicates.

    Half of the neighbours are those with the most similar poses. The others are spread over the next ones, every third,
    because successive images of a video have too little baseline for triangulation.
    """
    order = _dissimilarity(poses).argsort(dim=1, stable=True)
    ranks = _ranks(neighbours, len(poses) - 1)
    chosen = order[:, ranks]
    own = torch.arange(len(poses))[:, None].expand_as(chosen)
    pairs = torch.stack([own.minimum(chosen), own.maximum(chosen)], dim=-1).reshape(-1, 2)
    return pairs.unique(dim=0)


def _ranks(count: int, others: int) -> list[int]:
    """Return the ranks of the chosen neighbours: the first half are consecutive, then every third is taken."""
    near = (count + 1) // 2
    ranks = [*range(near), *(near + 2 + 3 * i for i in range(count - near))]
    return [rank for rank in ranks if rank < others] or list(range(others))


def _dissimilarity(poses: Sequence[SE3]) -> Float[Tensor, "v v"]:
    """Return how dissimilar two poses are: relative distance of the centres plus 1 - cosine between the optical axes.

    It is infinite between a view and itself.
    """
    centres = torch.stack([pose.translation.cpu().double() for pose in poses])
    axes = torch.stack([pose.rotation[:, 2].cpu().double() for pose in poses])
    away = torch.cdist(centres, centres)
    unlike = away / away.mean().clamp(min=1e-12) + 1 - axes @ axes.T
    return unlike.fill_diagonal_(torch.inf)
