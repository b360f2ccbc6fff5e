"""First-order descent on rendered images: the loop that ``bid`` and ``inerf`` are settings of."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from bidnerf_core.localization.problem import Problem
from bidnerf_core.localization.result import Localization
from bidnerf_core.localization.sampled import RayCounts, SampledLoss
from bidnerf_core.localization.settings import Judged
from bidnerf_core.localization.solvers.pivots import Pivot, PivotName, pivot
from bidnerf_core.localization.trail import AnswerName, Trail
from bidnerf_core.pixels import DrawerName
from bidnerf_core.residuals import Objective
from bidnerf_core.robust import RobustName
from bidnerf_core.se3 import SE3

Loss = Callable[[SE3], Tensor]


@dataclass(frozen=True)
class DescentConfig(Judged):
    """Settings that all first-order methods share."""

    rays: int = 2048  # in all, shared out equally among the views
    max_steps: int = 200
    learning_rate: float = 0.01  # metres and radians that a step moves by, at first
    decay: float = 0.8  # factor on the learning rate ...
    decay_steps: int = 100  # ... after so many steps
    pixels: DrawerName = "uniform"  # where pixels are drawn: anywhere, at corners, around corners
    renew: bool = True  # draw pixels anew at each step; else once
    colour_loss: RobustName = "huber"  # robust loss of colour differences
    colour_scale: float = 0.1  # of it, in differences of colour: about where an outlier begins
    level: int | None = None  # of the field: 0 is the coarsest; none is the field itself, in full detail
    pivot: PivotName = "camera"  # what an update turns about
    wide: float = 1.0  # sampled interval over [near, far]; the paper's "wide" is 2
    stop_loss: float = 0.0  # stop once the mean loss of 20 steps is below it (epsilon of Alg. 1); 0: never
    stop_step: float = 0.0  # stop once the mean length of 20 steps (metres, radians) is below it; 0: never
    answer: AnswerName = "last"  # the last pose, or that after the 20 steps of least mean loss
    converged_loss: float = 0.02  # mean loss of 20 steps below which the answer is called converged

    def __post_init__(self) -> None:
        for name in ("rays", "max_steps", "decay_steps"):
            self._require(name, 1 <= getattr(self, name) <= 10**7, "1 to 10 million")
        for name, most in {"learning_rate": 1e3, "decay": 1.0, "colour_scale": 1e6, "wide": 100.0}.items():
            self._require(name, 0 < getattr(self, name) <= most, f"a positive number, at most {most:g}")
        self._require_one_of(pixels=DrawerName, colour_loss=RobustName, pivot=PivotName, answer=AnswerName)
        for name in ("stop_loss", "stop_step", "converged_loss"):
            self._require_not_negative(name)


def descend(
    problem: Problem, config: DescentConfig, objective: Objective, depth_rays: int, seed: int, method: str
) -> Localization:
    """Follow Adam down the loss from ``problem.start`` (Alg. 1 of the paper, its loop test the right way round)."""
    began = time.perf_counter()
    start = problem.start_for(method)
    generator = torch.Generator().manual_seed(seed)
    counts = RayCounts(config.rays, depth_rays)
    loss = SampledLoss(
        problem, objective, counts, config.pixels, config.renew, config.level, config.wide, generator
    )
    trail = Trail([start])
    reason = _follow(loss, pivot(config.pivot, problem), config, trail)
    T, mean = trail.answer(config.answer)
    return Localization(
        T_world_camera=T,
        converged=mean < config.converged_loss,
        reason=reason,
        steps=len(trail.poses) - 1,
        seconds=time.perf_counter() - began,
        loss=mean,
        method=method,
        poses=SE3.stack(trail.poses),
        losses=torch.tensor(trail.losses, dtype=torch.float64),
    )


def _follow(loss: Loss, about: Pivot, config: DescentConfig, trail: Trail) -> str:
    """Take steps, and say why they ended.

    Each writes the pose as an update delta of the current one, takes the gradient by delta at 0, and moves by what Adam
    makes of it.
    """
    rho, phi = (torch.zeros(3, dtype=torch.float64, requires_grad=True) for _ in range(2))
    rates = (config.learning_rate, config.learning_rate / about.reach)
    groups = [{"params": [part], "lr": rate} for part, rate in zip((rho, phi), rates, strict=True)]
    optimizer = torch.optim.Adam(groups, betas=(0.9, 0.999))
    for step in range(config.max_steps):
        for group, rate in zip(optimizer.param_groups, rates, strict=True):
            group["lr"] = rate * config.decay ** (step / config.decay_steps)
        found = loss(about.moved(trail.T, torch.cat([rho, phi])))
        if not math.isfinite(float(found.detach())):
            return f"the loss was {float(found.detach())} at step {step + 1}"
        trail.losses.append(float(found.detach()))
        if found.requires_grad:  # it does not where no ray meets anything
            rho.grad, phi.grad = torch.autograd.grad(found, (rho, phi))
            optimizer.step()
        moved = about.moved(trail.T, torch.cat([rho, phi]).detach())
        if not bool(moved.matrix().isfinite().all()):
            return f"the step was not finite at step {step + 1}"
        trail.poses.append(moved.normalized())
        with torch.no_grad():
            rho.zero_()
            phi.zero_()
        enough = trail.stop(config.stop_loss, config.stop_step)
        if enough is not None:
            return enough
    return f"reached {config.max_steps} steps"
