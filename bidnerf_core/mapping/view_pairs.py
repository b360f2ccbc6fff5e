"""Which pairs of posed images are likely to show the same things."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor

from bidnerf_core.frames import View


def likely_pairs(views: Sequence[View], neighbours: int) -> Int[Tensor, "p 2"]:
    """Pairs (i < j) of each view with the ``neighbours`` views likeliest to show the same, without duplicates.

    Half of them are the likeliest. The others are spread over the three times as many that come next: successive images of a video
    are taken from nearly one place, and a point is triangulated well only from different ones.
    """
    order = _unlikeness(views).argsort(dim=1, stable=True)
    ranks = _ranks(neighbours, len(views) - 1)
    chosen = order[:, ranks]
    own = torch.arange(len(views))[:, None].expand_as(chosen)
    pairs = torch.stack([own.minimum(chosen), own.maximum(chosen)], dim=-1).reshape(-1, 2)
    return pairs.unique(dim=0)


def _ranks(count: int, others: int) -> list[int]:
    """Places in the order of likeliness: the first half one after the other, then every third."""
    near = (count + 1) // 2
    ranks = [*range(near), *(near + 2 + 3 * i for i in range(count - near))]
    return [rank for rank in ranks if rank < others] or list(range(others))


def _unlikeness(views: Sequence[View]) -> Float[Tensor, "v v"]:
    """Distance of the centres as a share of the mean distance, plus 1 - cosine between the axes; infinite to itself."""
    centres = torch.stack([view.T_ref_camera.translation.cpu().double() for view in views])
    axes = torch.stack([view.T_ref_camera.rotation[:, 2].cpu().double() for view in views])
    away = torch.cdist(centres, centres)
    unlike = away / away.mean().clamp(min=1e-12) + 1 - axes @ axes.T
    return unlike.fill_diagonal_(torch.inf)
