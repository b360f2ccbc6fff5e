"""From many poses to one: descend on few points, keep the best, go on with more points and finer scales."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.localization.alignment import Cloud, Scales, alignment, cost
from bidnerf_core.localization.solvers.levenberg_marquardt import descend
from bidnerf_core.mapping import SurfaceMap
from bidnerf_core.se3 import SE3

FINEST = 2.0
"""Scale of distances at the end, in cells of the map."""
JUDGED = 0.02
"""Scale of distances at which hypotheses are compared, as a share of the scene's extent."""
LIKE = 200
"""Points on which they are compared, at least."""
APART, TURNED = 0.05, math.radians(10)
"""Share of the extent, and radians, from which on two poses are different answers."""


@dataclass(frozen=True)
class Stage:
    """Some steps of all hypotheses that are left."""

    points: int
    steps: int
    keep: int
    distance: float  # share of the scene's extent; 0 is the finest
    colour_weight: float


# Colour has no say at first: its derivatives reach no farther than a surfel, and from afar they only hold a pose back.
STAGES = (
    Stage(48, 0, 96, 0.3, 0.0),
    Stage(48, 8, 24, 0.3, 0.0),
    Stage(100, 10, 6, 0.2, 0.0),
    Stage(400, 6, 2, 0.05, 0.1),
    Stage(2000, 4, 1, 0.0, 1.0),
)


@dataclass(frozen=True, eq=False)
class Found:
    """The pose that was found, and what else there was."""

    T: SE3
    score: float  # cost at the scale at which poses are compared, between 0 and 2
    lead: float  # by how much the best pose that is another one was worse, infinite where there was none
    path: SE3  # (s): poses from the hypothesis that led here to the end


def search(surface: SurfaceMap, cloud: Cloud, start: SE3, stages: tuple[Stage, ...] = STAGES) -> Found:
    """Successive halving over the hypotheses ``start`` (h)."""
    T, paths, lead = start, [start[None]], math.inf
    for stage in stages:
        some = cloud.first(stage.points)
        distance = stage.distance * surface.extent or FINEST * surface.cell
        evaluate = partial(alignment, surface, some, Scales(distance, colour_weight=stage.colour_weight))
        done = descend(evaluate, T, stage.steps, some.pivot.moved, damping=1e-4)
        judged = cloud.first(max(stage.points, LIKE))
        scores = score(surface, judged, done.T) if stage.steps else done.system.cost
        best = scores.argsort()[: stage.keep]
        paths = [path[:, best] for path in (*paths, done.poses[1:])]
        if stage.steps:
            now = _lead(surface, cloud, done.T[scores.argsort()], scores.sort().values)
            lead = now if math.isfinite(now) else lead
        T, scores = done.T[best], scores[best]
    return Found(T[0], float(scores[0]), lead, SE3.cat([path[:, 0] for path in paths]))


def score(surface: SurfaceMap, cloud: Cloud, T: SE3) -> Float[Tensor, "h"]:
    """What poses are compared by: the cost at one scale for all."""
    return cost(surface, cloud, Scales(JUDGED * surface.extent), T)


def _lead(surface: SurfaceMap, cloud: Cloud, T: SE3, scores: Float[Tensor, "h"]) -> float:
    """How much worse than the first of the poses T (best first) is the best that puts the middle of the cloud elsewhere
    or turns it otherwise.
    """
    middles = T.apply(cloud.middle.double())
    away = torch.linalg.vector_norm(middles - middles[0], dim=-1) > APART * surface.extent
    turned = (T.rotation[0].mT @ T.rotation).diagonal(dim1=-2, dim2=-1).sum(-1) < 1 + 2 * math.cos(TURNED)
    others = scores[away | turned]
    return float(others.min() - scores[0]) if len(others) else math.inf
