"""Levenberg-Marquardt: damped Gauss-Newton steps for a batch of poses."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bidnerf_core.devices import may_wait
from bidnerf_core.geometry import SE3
from bidnerf_core.localization.normal_equations import Cost, NormalEquations
from bidnerf_core.progress import check_stopped

LEAST_DAMPING, MOST_DAMPING = 1e-6, 1e6


@dataclass(frozen=True, eq=False)
class Descent:
    """The poses at the end of a descent, the cost there, and the path."""

    T: SE3  # (h)
    equations: NormalEquations  # at T
    accepted: Bool[Tensor, "s h"]  # which steps lowered the cost
    poses: SE3  # (s + 1, h)
    costs: Float[Tensor, "t h"]  # of these poses
    converged: Bool[Tensor, "h"]  # which poses reached a point where a step is shorter than ``stop``


def descend(
    cost: Cost,
    start: SE3,
    steps: int,
    retract: Callable[[SE3, Float[Tensor, "h 6"]], SE3] = SE3.retract,
    damping: float = 1e-3,
    stop: float = 0.0,
) -> Descent:
    """Take ``steps`` steps from the poses ``start`` (h); a step that does not lower its pose's cost is undone.

    Damping scales with the diagonal (Marquardt 1963), so units do not matter. A pose has converged once a lightly damped step is
    shorter than ``stop`` (norm of the tangent), whether or not it lowers the cost; 0 means never. The descent ends when all poses
    have converged, unless the host must not wait for the device.
    """
    T, here = start, cost(start)
    factor = torch.full_like(here.cost, damping)
    converged = torch.zeros_like(here.cost, dtype=torch.bool)
    accepted, poses, costs = [], [T], [here.cost]
    for _ in range(steps):
        check_stopped()
        delta = here.solve(factor)
        trial = retract(T, delta)
        there = cost(trial)
        better = there.cost < here.cost  # false for NaN
        converged |= _short(delta, factor, here, stop)
        T, here = _chosen(better, trial, T), there.chosen(better, here)
        factor = torch.where(better, factor / 4, factor * 6).clamp(LEAST_DAMPING, MOST_DAMPING)
        accepted.append(better)
        poses.append(T)
        costs.append(here.cost)
        if stop and may_wait(converged.device) and bool(converged.all()):
            break
    history = torch.stack(accepted) if accepted else torch.zeros((0, len(converged))).to(converged)
    return Descent(T, here, history, SE3.stack(poses), torch.stack(costs), converged)


def _short(
    delta: Float[Tensor, "h 6"], damping: Float[Tensor, "h"], here: NormalEquations, stop: float
) -> Bool[Tensor, "h"]:
    """Return a mask of steps shorter than ``stop`` due to a small gradient, not a failed solve or heavy damping."""
    whole = here.hessian.isfinite().all(-1).all(-1) & here.gradient.isfinite().all(-1)
    return whole & (damping <= 1) & (torch.linalg.vector_norm(delta, dim=-1) < stop)


def _chosen(which: Bool[Tensor, "h"], yes: SE3, no: SE3) -> SE3:
    return SE3(
        torch.where(which[:, None, None], yes.rotation, no.rotation),
        torch.where(which[:, None], yes.translation, no.translation),
    )
