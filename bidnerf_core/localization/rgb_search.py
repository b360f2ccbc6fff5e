"""From many poses to few without any depth: drawings beside the images, ever larger and of ever fewer poses."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from bidnerf_core.frames import View
from bidnerf_core.localization.drawing import Looks, compared
from bidnerf_core.localization.sketches import Sketcher
from bidnerf_core.localization.solvers.levenberg_marquardt import descend
from bidnerf_core.localization.solvers.pivots import Pivot
from bidnerf_core.localization.thumbnails import Thumbnail, thumbnail
from bidnerf_core.se3 import SE3

APART, TURNED = 0.15, math.radians(20)
"""Share of the extent, and radians, from which on two poses are different answers."""


@dataclass(frozen=True)
class Stage:
    """Some steps of the hypotheses that are left."""

    width: int  # pixels of the longer side of thumbnails
    steps: int
    keep: int


@dataclass(frozen=True, eq=False)
class Sight:
    """What is compared, and how."""

    views: Sequence[View]
    sketcher: Sketcher
    middle: Float[Tensor, "3"]  # metres, last camera: about what it looks at
    extent: float  # metres: of the scene
    looks: Looks = field(default_factory=Looks)

    def thumbnails(self, width: int) -> list[Thumbnail]:
        return [thumbnail(view, width) for view in self.views]

    @property
    def pivot(self) -> Pivot:
        """What updates turn about, as a cloud has it."""
        return Pivot.at_point(self.middle)


@dataclass(frozen=True, eq=False)
class Found:
    """The poses that were found."""

    T: SE3  # (h), best first
    costs: Float[Tensor, "h"]  # between 0 and 1
    lead: float  # by what share the best pose that is another one was worse, infinite where there was none
    path: SE3  # (s + 1): poses from the hypothesis that led to the first of them
    losses: Float[Tensor, "s"]  # of the path, before each step; from stage to stage, images differ


def search(sight: Sight, start: SE3, stages: Sequence[Stage]) -> Found:
    """Successive halving over the hypotheses ``start`` (h). A runner-up that is another pose stays to the end."""
    T, paths, losses = start, [start[None]], [torch.zeros((0, len(start.translation)), dtype=torch.float64)]
    for stage in stages:
        thumbnails = sight.thumbnails(stage.width)
        evaluate = partial(compared, sight.sketcher, thumbnails, sight.looks, sight.middle)
        done = descend(evaluate, T, stage.steps, sight.pivot.moved, damping=1e-2)
        kept = _kept(sight, done.T, done.system.cost, stage.keep)
        paths = [path[:, kept] for path in (*paths, done.poses[1:])]
        losses = [values[:, kept] for values in (*losses, done.costs[:-1])]
        T, costs = done.T[kept], done.system.cost[kept]
    others = costs[different(sight, T)]
    lead = float(others.min() / costs[0].clamp(min=1e-6)) - 1 if len(others) else math.inf
    path = SE3.cat([path[:, 0] for path in paths])
    return Found(T, costs, lead, path, torch.cat([values[:, 0] for values in losses]))


def _kept(sight: Sight, T: SE3, costs: Float[Tensor, "h"], count: int) -> Int[Tensor, "k"]:
    """Which are the best, best first; if they are all the same pose, the last makes room for one that is another."""
    order = costs.argsort()
    best, others = order[:count], order[different(sight, T[order])]
    if count > 1 and len(others) and not bool(different(sight, T[best]).any()):
        best = torch.cat([best[:-1], others[:1]])
    return best


def different(sight: Sight, T: SE3) -> Bool[Tensor, "h"]:
    """Which poses look elsewhere than the first of them, or are turned otherwise: farther than steps of one have to go."""
    middles = T.apply(sight.middle.double())
    away = torch.linalg.vector_norm(middles - middles[0], dim=-1) > APART * sight.extent
    turned = (T.rotation[0].mT @ T.rotation).diagonal(dim1=-2, dim2=-1).sum(-1) < 1 + 2 * math.cos(TURNED)
    return away | turned
