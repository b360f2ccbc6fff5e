"""First-order methods: Adam on the loss of sampled rays, of which ``bid`` and ``inerf`` are two configurations."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Annotated

import torch

from bidnerf_core.localization.acceptance import descent_verdict
from bidnerf_core.localization.costs.sampled import SampledLoss
from bidnerf_core.localization.costs.weighted_rays import RayCounts
from bidnerf_core.localization.method_settings import AdamSettings
from bidnerf_core.localization.pivots import PivotName, pivot
from bidnerf_core.localization.problem import Problem
from bidnerf_core.localization.result import Localization
from bidnerf_core.localization.solvers.adam import follow_gradient
from bidnerf_core.localization.solvers.history import History
from bidnerf_core.pixels import DrawerName
from bidnerf_core.residuals import Objective
from bidnerf_core.se3 import SE3
from bidnerf_core.settings import EXPERT, Above, Count, Settings


@dataclass(frozen=True)
class DescentSettings(Settings):
    """Settings of the rays of a step, and of the frame of updates."""

    rays: Count = 2048  # number of rays a step, shared out equally among the views
    level: int | None = None  # level of the field: 0 is the coarsest, None the field itself
    pixels: DrawerName = "uniform"  # where pixels are drawn: anywhere, at corners, around corners
    pivot: PivotName = "camera"  # what an update turns about: camera, world, or the middle of the scene
    # length of the sampled interval, in units of [near, far]; the paper's "wide" is 2
    wide: Annotated[float, Above(0.0, 100.0)] = 1.0
    renew: Annotated[bool, EXPERT] = True  # draw pixels anew at each step instead of once


def descended(
    problem: Problem, rays: DescentSettings, adam: AdamSettings, objective: Objective, depth_rays: int, seed: int,
    method: str,
) -> Localization:  # fmt: skip
    """Descend with Adam from ``problem.start`` (Alg. 1) and judge the answer."""
    began = time.perf_counter()
    start, generator = problem.start_for(method), torch.Generator().manual_seed(seed)
    counts = RayCounts(rays.rays, depth_rays)
    loss = SampledLoss(problem, objective, counts, rays.pixels, rays.renew, rays.level, rays.wide, generator)
    history = History([start])
    finite, reason = follow_gradient(loss, pivot(rays.pivot, problem), adam, history)
    T, mean = history.answer(adam.answer)
    verdict = descent_verdict(mean, adam.converged_loss, finite, reason)
    return Localization(
        T_world_camera=T,
        outcome=verdict.outcome,
        reason=verdict.reason,
        steps=len(history.poses) - 1,
        seconds=time.perf_counter() - began,
        loss=mean,
        method=method,
        poses=SE3.stack(history.poses),
        losses=torch.tensor(history.losses, dtype=torch.float64),
    )
