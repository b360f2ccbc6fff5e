"""Levenberg-Marquardt for h hypotheses at once.

Damping, acceptance and termination are tensors, so the host need not wait for the accelerator.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import pad

from bidnerf_core.devices import constant
from bidnerf_core.geometry import SE3, skew
from bidnerf_core.mapping.resection.states import P, States

SETTLED = 0.01
"""Predicted decrease of the cost below which a hypothesis has converged."""


@dataclass(frozen=True, eq=False)
class Normal:
    """A cost (a negative log likelihood) with its gradient and Gauss-Newton Hessian, for h states."""

    cost: Float[Tensor, "h"]
    gradient: Float[Tensor, "h P"]
    hessian: Float[Tensor, "h P P"]

    def __add__(self, other: Normal) -> Normal:
        return Normal(self.cost + other.cost, self.gradient + other.gradient, self.hessian + other.hessian)

    def __sub__(self, other: Normal) -> Normal:
        return Normal(self.cost - other.cost, self.gradient - other.gradient, self.hessian - other.hessian)

    def where(self, mask: Bool[Tensor, "h"], other: Normal) -> Normal:
        return Normal(
            torch.where(mask, self.cost, other.cost),
            torch.where(mask[:, None], self.gradient, other.gradient),
            torch.where(mask[:, None, None], self.hessian, other.hessian),
        )


CostTerm = Callable[[States], Normal]
"""Evaluates one kind of measurement at h states."""


def prior(states: States) -> Normal:
    """Return the prior: standard normal for the nuisances, flat for the pose."""
    z = states.z
    free = constant((0.0,) * 6 + (1.0,) * (P - 6), z).diag_embed()
    return Normal(0.5 * z.square().sum(-1), pad(z, (6, 0)), free.expand(len(z), P, P))


@dataclass(frozen=True, eq=False)
class GaussianPrior:
    """A Gaussian prior on the pose: the cost is ``xi^T information xi / 2`` for the right update xi from ``mean`` to the pose."""

    mean: SE3  # T_world_rig
    information: Float[Tensor, "6 6"]  # inverse covariance; translation (metres) before rotation (radians)

    def __call__(self, states: States) -> Normal:
        xi = self.mean.update_to(states.T)
        by_translation, by_rotation = (skew(part) for part in xi.split(3, -1))
        adjoint = torch.cat([by_rotation, by_translation], -1)
        adjoint = torch.cat([adjoint, pad(by_rotation, (3, 0))], -2)
        # The derivative of xi is the inverse right Jacobian (Sola et al. 2018, eq. 179), here to the second order.
        slope = torch.eye(6).to(xi) + adjoint / 2 + adjoint @ adjoint / 12
        pull, rest = xi @ self.information, P - 6
        gradient, hessian = (pull[:, None] @ slope)[:, 0], slope.mT @ self.information @ slope
        return Normal((pull * xi).sum(-1) / 2, pad(gradient, (0, rest)), pad(hessian, (0, rest, 0, rest)))


def total(states: States, terms: Sequence[CostTerm]) -> Normal:
    return sum((term(states) for term in terms), start=prior(states))


def descend(
    states: States,
    terms: Sequence[CostTerm],
    steps: int,
    pivot: Float[Tensor, "3"] | None = None,
    path: list[tuple[SE3, Float[Tensor, "h"]]] | None = None,
) -> tuple[States, Normal]:
    """Minimize the sum of ``terms`` and the prior from each state; a step that does not lower the sum is not taken.

    Steps are damped as updates that rotate about ``pivot`` (metres, the rig's frame), by default the rig's origin. A pivot in the middle of
    the visible scene decouples rotation and translation. Poses and costs before each step are appended to ``path``.
    """
    here = total(states, terms)
    damping = torch.full_like(here.cost, 1e-3)
    about = None if pivot is None else _about(pivot.to(here.hessian))
    for _ in range(steps):
        if path is not None:
            path.append((states.T, here.cost))
        step = damped_solution(here, damping, about)
        settled = ((step * here.gradient).sum(-1) < SETTLED).all()
        if step.device.type == "cpu" and bool(settled):  # elsewhere, the host would wait for the device
            break
        moved = states.retract(-step)
        there = total(moved, terms)
        better = (there.cost < here.cost) & ~settled  # false for NaN
        states, here = moved.where(better, states), there.where(better, here)
        damping = torch.where(better, damping * 0.2, damping * 8)
    return states, here


@dataclass(frozen=True, eq=False)
class Quadratic:
    """Quadratic models of terms, one about a state of each mode; with them, linear algebra evaluates all explanations of a mode's matches.

    The unknowns are the pose's update (metres, radians) and the nuisances in their own units.
    """

    here: States  # (g)
    cost: Float[Tensor, "g"]
    gradient: Float[Tensor, "g P"]
    hessian: Float[Tensor, "g P P"]

    @staticmethod
    def of(found: Normal, here: States) -> Quadratic:
        """Build the models from normal equations, without priors, at the states ``here`` (g), where no nuisance is fixed."""
        unit = here.unit
        return Quadratic(here, found.cost, found.gradient * unit, unit[:, :, None] * found.hessian * unit[:, None])

    def __call__(self, states: States) -> Normal:
        g = states.mode
        off = torch.cat([self.here.T[g].update_to(states.T), states.nuisances - self.here.nuisances[g]], -1)
        scale = 1 / states.unit
        pull = self.gradient[g] + (self.hessian[g] @ off[..., None])[..., 0]
        cost = self.cost[g] + 0.5 * ((pull + self.gradient[g]) * off).sum(-1)
        return Normal(cost, pull * scale, scale[:, :, None] * self.hessian[g] * scale[:, None])

    def with_rows_added(self, which: Int[Tensor, "r"], other: Quadratic) -> Quadratic:
        """Return the models with ``other``, models of further terms about the states ``which``, added to theirs."""
        parts = ((getattr(self, name), getattr(other, name)) for name in ("cost", "gradient", "hessian"))
        return Quadratic(self.here, *(own.index_add(0, which, more) for own, more in parts))

    def minimum(self, states: States) -> tuple[States, Normal]:
        """Minimize the sum of the models and the prior from each state; the second step accounts for the curvature of rotations."""
        for _ in range(2):
            normal = total(states, [self])
            states = states.retract(-damped_solution(normal, torch.zeros_like(normal.cost)))
        return states, total(states, [self])


def _about(pivot: Float[Tensor, "3"]) -> Float[Tensor, "P P"]:
    """Return the matrix that converts an update with rotation about ``pivot`` to the same update about the rig's origin."""
    found = torch.eye(P, dtype=pivot.dtype, device=pivot.device)
    found[:3, 3:6] = skew(pivot)
    return found


def damped_solution(
    normal: Normal, damping: Float[Tensor, "h"], about: Float[Tensor, "P P"] | None = None
) -> Float[Tensor, "h P"]:
    gradient, hessian = normal.gradient, normal.hessian
    if about is not None:
        gradient, hessian = gradient @ about, about.mT @ hessian @ about
    diagonal = hessian.diagonal(dim1=-2, dim2=-1).clamp(min=1e-12)
    # Scaled to a unit diagonal, whatever the units; along directions without information the step is 0.
    unit = diagonal.rsqrt()
    scaled = unit[..., None] * hessian * unit[..., None, :]
    scaled.diagonal(dim1=-2, dim2=-1).add_(damping[:, None] + 1e-9)
    factor, info = torch.linalg.cholesky_ex(scaled)
    # Two triangular solves: cholesky_solve uses a library that cannot be captured in a CUDA graph.
    half = torch.linalg.solve_triangular(factor, (unit * gradient)[..., None], upper=False)
    step = unit * torch.linalg.solve_triangular(factor.mT, half, upper=True)[..., 0]
    step = torch.where(((info == 0) & step.isfinite().all(-1))[:, None], step, 0)
    return step if about is None else step @ about.mT


def log_det(hessian: Float[Tensor, "h p p"]) -> Float[Tensor, "h"]:
    """Return the log determinants of positive definite matrices; infinite for other matrices."""
    factor, info = torch.linalg.cholesky_ex(hessian)
    found = 2 * factor.diagonal(dim1=-2, dim2=-1).clamp(min=1e-300).log().sum(-1)
    return torch.where(info == 0, found, torch.inf)


def log_evidence(states: States, normal: Normal) -> Float[Tensor, "h"]:
    """Return Laplace's approximation of the log evidence of each hypothesis at its minimum (MacKay 2003, ch. 28)."""
    log = states.log_prior - normal.cost - 0.5 * log_det(normal.hessian)
    return torch.where(log.isfinite(), log, -torch.inf)
