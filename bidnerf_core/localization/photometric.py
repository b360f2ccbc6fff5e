"""Second-order refinement of poses on rendered rays, for any differentiable field.

Levenberg-Marquardt from coarse to fine. Within a stage the rays stay what they are, so that a step that does not lower
the cost can be told and taken back; each stage draws its own. Poses are a batch axis: several are refined at once, and
each stage goes on with the best of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Generator, Tensor

from bidnerf_core.localization.look import Look, look_at
from bidnerf_core.localization.problem import Problem
from bidnerf_core.localization.solvers.levenberg_marquardt import descend, solve
from bidnerf_core.localization.solvers.pivots import pivot
from bidnerf_core.localization.stages import Refinement, Stage
from bidnerf_core.se3 import SE3


@dataclass(frozen=True, eq=False)
class Refined:
    """The best pose and what can be said of it."""

    T: SE3
    loss: float  # here and below, on rays that it was not fitted to, by the measure of the last stage
    inliers: float  # share of the rays on which all that was measured is seen
    covariance: Float[
        Tensor, "6 6"
    ]  # of a right update at the camera: translation in metres, rotation in radians
    step: float  # length of the step that these rays would take from here (metres, radians)
    poses: SE3  # (steps + 1): the first pose given, then the best one after each step
    losses: Float[Tensor, "s"]  # before each step


def refine(
    problem: Problem, start: SE3, stages: Sequence[Stage], settings: Refinement, generator: Generator
) -> Refined:
    """From poses (h), of which each stage takes the best; ``problem.start`` is not looked at.

    The answer is the best of the last two stages by rays that neither was fitted to.
    """
    about = pivot(settings.pivot, replace(problem, start=start[0]))
    trail = Trail(start[0])
    T, ends = start, []
    for stage in stages:
        look = look_at(problem, stage, settings, about, generator)
        for _ in range(stage.centring):
            T = look.centred(T)
        T = _ranked(look, T, trail) if stage.steps == 0 else _descended(look, T[: stage.keep], trail)
        ends.append(T[0])
    return _judged(look.anew(generator), SE3.stack(ends[-2:]), trail)


@dataclass(frozen=True, eq=False)
class Steps:
    """Where a few steps led."""

    poses: SE3  # (s + 1)
    inliers: float  # share of the rays that see what was measured from the last of them


def stepped(problem: Problem, start: SE3, stage: Stage, settings: Refinement, generator: Generator) -> Steps:
    """Up to ``stage.steps`` second-order steps from one pose, on one draw of rays, for what is nearly there.

    It ends before a step that does not lower the cost. Nothing is judged on rays of its own afterwards, and the last step
    needs no derivatives: half of what ``refine`` costs.
    """
    look = look_at(problem, stage, settings, pivot(settings.pivot, replace(problem, start=start)), generator)
    poses, here = [start], look.residuals(start[None])
    for left in reversed(range(stage.steps)):
        system = here.system()
        delta = solve(system, torch.full_like(system.cost, stage.damping))
        trial = look.about.moved(poses[-1][None], delta)
        there = look.residuals(trial, derivatives=left > 0)
        if not bool(there.system().cost[0] < system.cost[0]):
            break
        poses.append(trial[0])
        here = there
    return Steps(SE3.stack(poses), float(here.inliers()[0]))


class Trail:
    """The best pose after each step, and its cost before it."""

    def __init__(self, start: SE3) -> None:
        self.poses, self.losses = [start], list[float]()

    def add(self, poses: SE3, costs: Float[Tensor, "t h"]) -> None:
        """Poses (t h) of a stage and their costs; the first of them are those it began with."""
        best = costs.argmin(-1).tolist()
        self.poses += [poses[i, best[i]] for i in range(1, len(best))]
        self.losses += (costs.amin(-1)[:-1] / 2).tolist()


def _ranked(look: Look, T: SE3, trail: Trail) -> SE3:
    costs = look.cost(T)
    order = costs.argsort()
    trail.poses.append(T[order[0]])
    trail.losses.append(float(costs[0]) / 2)
    return T[order]


def _descended(look: Look, T: SE3, trail: Trail) -> SE3:
    stage, about = look.stage, look.about
    found = descend(look.system, T, stage.steps, about.moved, stage.damping, look.settings.stop_step)
    trail.add(found.poses, found.costs)
    return found.T[found.system.cost.argsort()].normalized()


def _judged(look: Look, T: SE3, trail: Trail) -> Refined:
    residuals = look.residuals(T)
    system = residuals.system()
    best = int(system.cost.argmin())
    trail.poses[-1] = T[best]
    covariance = look.about.at_camera(T[best], residuals.covariance()[best])
    return Refined(
        T=T[best],
        loss=float(system.cost[best]) / 2,
        inliers=float(residuals.inliers()[best]),
        covariance=covariance,
        step=float(torch.linalg.vector_norm(solve(system, torch.zeros_like(system.cost))[best])),
        poses=SE3.stack(trail.poses),
        losses=torch.tensor(trail.losses, dtype=torch.float64),
    )
