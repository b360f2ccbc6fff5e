"""Costs of poses and their quadratic models: the interface between costs and solvers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.geometry import SE3, se3_right_jacobian
from bidnerf_core.localization.solvers.pivots import Pivot

ROUNDING = 1e-9
"""Damping that is always added, so that the step is 0 along directions on which the cost does not depend."""


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """A cost and its Gauss-Newton model ``cost + 2 g.xi + xi.H.xi``, for each of h poses; float64.

    The k unknowns are the six of a pose's update, possibly followed by others.
    """

    cost: Float[Tensor, "h"]
    gradient: Float[Tensor, "h k"]
    hessian: Float[Tensor, "h k k"]

    def __add__(self, other: NormalEquations) -> NormalEquations:
        return NormalEquations(
            self.cost + other.cost, self.gradient + other.gradient, self.hessian + other.hessian
        )

    def scaled(self, factor: float) -> NormalEquations:
        """Return the equations of the cost multiplied by ``factor``."""
        return NormalEquations(factor * self.cost, factor * self.gradient, factor * self.hessian)

    def of_others(self, updates: Float[Tensor, "k n"]) -> NormalEquations:
        """Return the equations in n other unknowns, which the matrix ``updates`` maps to these unknowns."""
        return NormalEquations(self.cost, self.gradient @ updates, updates.mT @ self.hessian @ updates)

    def chosen(self, which: Tensor, other: NormalEquations) -> NormalEquations:
        """Return these equations where ``which`` (h) holds, and ``other`` elsewhere."""
        return NormalEquations(
            torch.where(which, self.cost, other.cost),
            torch.where(which[:, None], self.gradient, other.gradient),
            torch.where(which[:, None, None], self.hessian, other.hessian),
        )

    def solve(self, damping: Float[Tensor, "h"]) -> Float[Tensor, "h k"]:
        """Return the step of ``(H + damping diag H) xi = -g``, by Cholesky; 0 where the equations cannot be solved."""
        diagonal = self.hessian.diagonal(dim1=-2, dim2=-1)
        unit = torch.where(diagonal > 0, diagonal, 1).rsqrt()  # scales the diagonal to 1, whatever the units
        scaled = unit[..., None] * self.hessian * unit[..., None, :]
        eye = torch.eye(scaled.shape[-1], dtype=scaled.dtype, device=scaled.device)
        factor, failed = torch.linalg.cholesky_ex(scaled + (damping[:, None, None] + ROUNDING) * eye)
        delta = -unit * torch.cholesky_solve((unit * self.gradient)[..., None], factor)[..., 0]
        sound = (failed == 0) & (diagonal >= 0).all(-1) & delta.isfinite().all(-1)
        return torch.where(sound[:, None], delta, 0)


@runtime_checkable
class Cost(Protocol):
    """Computes the cost of each pose of a batch, with its normal equations."""

    def __call__(self, T: SE3) -> NormalEquations: ...


@dataclass(frozen=True)
class Sum:
    """The sum of several costs, which is a cost."""

    costs: tuple[Cost, ...]

    def __call__(self, T: SE3) -> NormalEquations:
        first, *others = (cost(T) for cost in self.costs)
        return sum(others, start=first)


@dataclass(frozen=True)
class Scaled:
    """A cost multiplied by a constant weight."""

    cost: Cost
    factor: float

    def __call__(self, T: SE3) -> NormalEquations:
        return self.cost(T).scaled(self.factor)


@dataclass(frozen=True, eq=False)
class GaussianPrior:
    """The squared Mahalanobis distance of poses from a mean; updates are expressed about ``pivot``."""

    mean: SE3  # T_world_camera
    covariance: Float[Tensor, "6 6"]  # of a right update of the mean (metres, radians); float64
    pivot: Pivot

    @property
    def at_pivot(self) -> Float[Tensor, "6 6"]:
        """The covariance of an update of the mean about the pivot."""
        back = torch.linalg.inv(self.pivot.update_at_camera(self.mean))
        return back @ self.covariance @ back.mT

    def __call__(self, T: SE3) -> NormalEquations:
        inverse = self.mean.inverse()
        off = (SE3(inverse.rotation[None], inverse.translation[None]) @ T).log()
        # log(exp(off) exp(d)) = off + J_r(off)^-1 d to first order (Sola et al. 2018, eq. 76).
        off_by_update = torch.linalg.inv(se3_right_jacobian(off)) @ self.pivot.update_at_camera(T)
        information = torch.linalg.inv(self.covariance)
        pulled = information @ off_by_update
        return NormalEquations(
            torch.einsum("hi,ij,hj->h", off, information, off),
            torch.einsum("hi,hij->hj", off, pulled),
            off_by_update.mT @ pulled,
        )
