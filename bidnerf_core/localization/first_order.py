"""First-order methods: Adam on the loss of sampled rays, of which ``bid`` and ``inerf`` are two configurations."""

from __future__ import annotations

import math
import statistics
import time

import torch

from bidnerf_core.fields.residuals import Objective
from bidnerf_core.geometry.se3 import SE3
from bidnerf_core.localization.acceptance import BLANK, descent_verdict, is_blank
from bidnerf_core.localization.costs.sampled import SampledLoss
from bidnerf_core.localization.costs.weighted_rays import RayCounts
from bidnerf_core.localization.method_settings import AdamSettings, DescentSettings, ReachSettings
from bidnerf_core.localization.pivots import pivot
from bidnerf_core.localization.problem import Problem
from bidnerf_core.localization.result import Localization, Outcome
from bidnerf_core.localization.solvers.adam import follow_gradient
from bidnerf_core.localization.solvers.history import History

PAPERS_REACH = ReachSettings()
"""The paper's objective, with nothing added."""


def descended(
    problem: Problem, rays: DescentSettings, adam: AdamSettings, objective: Objective, depth_rays: int, seed: int,
    method: str, reach: ReachSettings = PAPERS_REACH,
) -> Localization:  # fmt: skip
    """Descend with Adam from ``problem.start`` (Alg. 1) and judge the answer."""
    began = time.perf_counter()
    start, device = problem.start_for(method), problem.device
    generator = torch.Generator(device).manual_seed(seed)
    loss = SampledLoss(
        problem.on_device(), objective, RayCounts(rays.rays, depth_rays), rays, reach, generator
    )
    history = History([start])
    finite, reason = follow_gradient(
        loss, pivot(rays.pivot, problem), adam, history, device, generator if loss.is_capturable else None
    )
    T, mean = history.answer(adam.answer)
    by_depth = objective.uses_depth and problem.has_depth
    plain = math.inf if by_depth else adam.plain_share * _plain_loss(problem, objective)
    verdict = descent_verdict(mean, adam.converged_loss, finite, reason, plain)
    fits = verdict.outcome in (Outcome.CONVERGED, Outcome.UNDETERMINED)
    if fits and not by_depth and all(is_blank(view.frame) for view in problem.views):
        verdict = BLANK
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


def _plain_loss(problem: Problem, objective: Objective) -> float:
    """Return the loss if each image were rendered in its mean colour; infinite without colours."""
    images = [view.frame for view in problem.views if view.frame.has_colour]
    if not images:
        return math.inf
    return statistics.fmean(objective.plain_loss(frame.rgb.flatten(0, 1)) for frame in images)
