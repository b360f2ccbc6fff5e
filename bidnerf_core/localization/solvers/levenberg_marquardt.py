"""Damped Gauss-Newton steps for many poses at once."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bidnerf_core.se3 import SE3

LEAST, MOST = 1e-6, 1e6
"""Of the damping."""

ROUNDING = 1e-9
"""Added to it, so that a direction that the cost is blind to can be solved for: the step has nothing along it."""


@dataclass(frozen=True, eq=False)
class System:
    """A cost and its Gauss-Newton approximation ``cost + 2 g.xi + xi.H.xi``, for each of h poses; float64."""

    cost: Float[Tensor, "h"]
    gradient: Float[Tensor, "h 6"]
    hessian: Float[Tensor, "h 6 6"]


@dataclass(frozen=True, eq=False)
class Descent:
    """Where the poses came to, and what the cost looks like there."""

    T: SE3  # (h)
    system: System
    accepted: Bool[Tensor, "s h"]  # which steps lowered the cost
    poses: SE3  # (s + 1, h)
    costs: Float[Tensor, "t h"]  # of them
    settled: Bool[Tensor, "h"]  # which poses came to where a step is shorter than ``stop``


def descend(
    evaluate: Callable[[SE3], System],
    start: SE3,
    steps: int,
    retract: Callable[[SE3, Float[Tensor, "h 6"]], SE3] = SE3.retract,
    damping: float = 1e-3,
    stop: float = 0.0,
) -> Descent:
    """``steps`` of Levenberg-Marquardt; a step that does not lower the cost of its pose is taken back.

    Damping scales with the diagonal (Marquardt 1963), so that no unit matters. ``stop``: a pose has settled once a step
    that little damping shortens is shorter than this (norm of the tangent), whether it lowers the cost or only rounding is
    left of it; end once every pose has. 0: never.
    """
    T, system = start, evaluate(start)
    factor = torch.full_like(system.cost, damping)
    settled = torch.zeros_like(system.cost, dtype=torch.bool)
    accepted, poses, costs = [], [T], [system.cost]
    for _ in range(steps):
        delta = solve(system, factor)
        trial = retract(T, delta)
        tried = evaluate(trial)
        better = tried.cost < system.cost  # never where it is NaN
        settled |= _short(delta, factor, system, stop)
        T, system = _chosen(better, trial, T), _chosen_system(better, tried, system)
        factor = torch.where(better, factor / 4, factor * 6).clamp(LEAST, MOST)
        accepted.append(better)
        poses.append(T)
        costs.append(system.cost)
        if stop and bool(settled.all()):
            break
    history = torch.stack(accepted) if accepted else torch.zeros((0, len(settled))).to(settled)
    return Descent(T, system, history, SE3.stack(poses), torch.stack(costs), settled)


def solve(system: System, damping: Float[Tensor, "h"]) -> Float[Tensor, "h 6"]:
    """``(H + damping diag H) xi = -g``, by Cholesky; no step where the system cannot be solved."""
    diagonal = system.hessian.diagonal(dim1=-2, dim2=-1)
    unit = torch.where(diagonal > 0, diagonal, 1).rsqrt()  # makes the diagonal 1, whatever the units
    scaled = unit[..., None] * system.hessian * unit[..., None, :]
    eye = torch.eye(6, dtype=scaled.dtype, device=scaled.device)
    factor, failed = torch.linalg.cholesky_ex(scaled + (damping[:, None, None] + ROUNDING) * eye)
    delta = -unit * torch.cholesky_solve((unit * system.gradient)[..., None], factor)[..., 0]
    sound = (failed == 0) & (diagonal >= 0).all(-1) & delta.isfinite().all(-1)
    return torch.where(sound[:, None], delta, 0)


def _short(
    delta: Float[Tensor, "h 6"], damping: Float[Tensor, "h"], system: System, stop: float
) -> Bool[Tensor, "h"]:
    """Steps shorter than ``stop``. A failed solve and heavy damping make short steps as well: they say nothing."""
    whole = system.hessian.isfinite().all(-1).all(-1) & system.gradient.isfinite().all(-1)
    return whole & (damping <= 1) & (torch.linalg.vector_norm(delta, dim=-1) < stop)


def _chosen(which: Bool[Tensor, "h"], yes: SE3, no: SE3) -> SE3:
    return SE3(
        torch.where(which[:, None, None], yes.rotation, no.rotation),
        torch.where(which[:, None], yes.translation, no.translation),
    )


def _chosen_system(which: Bool[Tensor, "h"], yes: System, no: System) -> System:
    return System(
        torch.where(which, yes.cost, no.cost),
        torch.where(which[:, None], yes.gradient, no.gradient),
        torch.where(which[:, None, None], yes.hessian, no.hessian),
    )
