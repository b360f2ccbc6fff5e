"""Rays of a closed-form scene with measurements that differ from it, for tests of residuals and their derivatives."""

from __future__ import annotations

from dataclasses import replace

import torch

from bidnerf_core.fields import Objective, Observations, Rays, SceneBounds, colour_term, depth_term
from bidnerf_core.geometry import SE3, Robust
from bidnerf_core.localization import Pivot
from bidnerf_core.localization.costs.linearization import Linearization, linearize
from bidnerf_core.localization.costs.rendered import WeightedRays
from bidnerf_core.scenes import GaussianBlobs, orbit

BOUNDS = SceneBounds((-2.0, -2.0, -2.0), (2.0, 2.0, 2.0), 0.1, 12.0, (1.0, 0.9, 0.8))
FIELD = GaussianBlobs.random()
POSES = SE3.stack(orbit(4.0, 3, seed=1))
PIVOTS = {
    "camera": Pivot(SE3.identity()),
    "scene": Pivot(
        SE3(torch.eye(3, dtype=torch.float64), torch.tensor([0.1, -0.2, 3.9], dtype=torch.float64))
    ),
    "world": Pivot(None),
}
MISS = 0.5
OBJECTIVE = Objective((colour_term(Robust("cauchy", 0.2)), depth_term(Robust("cauchy", 0.3), 2.0, miss=MISS)))


def observations(count: int = 40) -> Observations:
    """Return rays towards the scene that measured something else than what is there, some of them no depth."""
    generator = torch.Generator().manual_seed(0)
    across = 0.5 * torch.rand((count, 2), generator=generator, dtype=torch.float64) - 0.25
    directions = torch.nn.functional.normalize(
        torch.cat([across, torch.ones_like(across[:, :1])], -1), dim=-1
    )
    measured = torch.rand((count, 4), generator=generator, dtype=torch.float64)
    distance = torch.where(measured[:, 3] > 0.3, 3.5 + measured[:, 3], 0)
    coloured = torch.ones(count, dtype=torch.bool)
    return Observations(0.05 * measured[:, :3], directions, measured[:, :3], distance, coloured)


OBSERVED = observations()
RAYS = WeightedRays(OBSERVED, OBJECTIVE.weights(OBSERVED[None])[0])


def held(T: SE3) -> Rays:
    """Return the rays from T on the intervals that they have at POSES: an interval has no derivative."""
    here, moved = OBSERVED.rays(POSES, BOUNDS), OBSERVED.rays(T, BOUNDS)
    return replace(moved, near=here.near, far=here.far)


def seen(T: SE3, about: Pivot, least_weight: float = 0.0) -> Linearization:
    return linearize(
        FIELD, held(T), OBSERVED, OBJECTIVE.residuals, about.at(T), BOUNDS.background, least_weight
    )
