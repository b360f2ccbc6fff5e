"""A camera's parameters under Gaussian priors, with the pose eliminated from the normal equations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bidnerf_core.mapping.geometry.projection import Array
from bidnerf_core.mapping.geometry.reprojection import RobustEquations, damped_solution

TIED = 1e-9
"""Standard deviation of parameters that a prior fixes at its mean."""


@dataclass(frozen=True)
class Conditional:
    """The most probable unknowns under each of ``k`` priors, and the evidence for the priors."""

    log_evidence: Array  # (k,) up to a constant
    update: Array  # (k, 6) right update of the pose (translation first)
    parameters: Array  # (k, p)
    covariance: Array  # (k, 6, 6) part of the pose's covariance due to the parameters
    by_fit: Array  # (k, 6, 6) the same for the apparent parameters, see ``EliminatedPose.given``


@dataclass(frozen=True)
class EliminatedPose:
    """The quadratic cost in a camera's parameters after eliminating the pose (Schur complement).

    The optimal pose is a linear function of the parameters.
    """

    here: Array  # (p,) values of the parameters
    cost: float
    hessian: Array  # (p, p)
    gradient: Array  # (p,)
    update: Array  # (6,) optimal update of the pose with the parameters held at ``here``
    follows: Array  # (6, p) derivative of the best pose with respect to the parameters

    @staticmethod
    def of(system: RobustEquations, here: Array) -> EliminatedPose:
        """Eliminate the pose, the first six unknowns, from equations without priors."""
        hessian, gradient = system.hessian, system.gradient
        right = np.column_stack([hessian[:6, 6:], gradient[:6]])
        solved = -damped_solution(hessian[:6, :6], 1e-9, right)
        follows, update = solved[:, :-1], solved[:, -1]
        return EliminatedPose(
            here, system.cost, hessian[6:, 6:] + hessian[6:, :6] @ follows, gradient[6:] + hessian[6:, :6] @ update,
            update, follows,
        )  # fmt: skip

    def given(self, mean: Array, deviations: Array, spurious: Array) -> Conditional:
        """Return the unknowns under Gaussian priors, ``mean`` and ``deviations`` (k, p), and the evidence for each.

        ``spurious`` (p,) are standard deviations of systematic errors in the parameters that the observations suggest: the
        apparent parameters scatter by them in addition to the prior. The evidence is in Laplace's approximation.
        """
        deviations = np.maximum(deviations, TIED)
        total = np.hypot(deviations, spurious)
        # In units of the prior, since its deviations differ by many orders of magnitude.
        outer = total[:, :, None] * total[:, None]
        scaled = self.hessian * outer + np.eye(len(self.here))
        right = self.gradient * total + (self.here - mean) / total
        step = -np.linalg.solve(scaled, right[..., None])[..., 0] * total
        off = self.here - mean + step
        quadratic = 0.5 * np.einsum("ki,ij,kj->k", step, self.hessian, step)
        cost = self.cost + step @ self.gradient + quadratic + 0.5 * ((off / total) ** 2).sum(1)
        apparent = np.linalg.inv(scaled) * outer
        # The true parameters, given the apparent ones.
        share = (deviations / total) ** 2
        variance = share[:, :, None] * apparent * share[:, None]
        variance += (share * spurious**2)[:, :, None] * np.eye(len(self.here))
        true = mean + share * off
        return Conditional(
            -cost - 0.5 * np.linalg.slogdet(scaled)[1], self.update + (true - self.here) @ self.follows.T, true,
            self.spread(variance), self.spread(apparent),
        )  # fmt: skip

    def spread(self, variance: Array) -> Array:
        """Propagate the covariance of the parameters, ``variance`` (k, p, p), to the pose: (k, 6, 6)."""
        found: Array = self.follows @ variance @ self.follows.T
        return (found + np.swapaxes(found, -1, -2)) / 2
