"""Normal equations of a robust cost, and the covariance that they give."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bidnerf_core.geometry.robust import MAD_TO_SIGMA

Array = np.ndarray


@dataclass(frozen=True, eq=False)
class RobustEquations:
    """A robust cost at some values of the unknowns, with its derivatives."""

    cost: float
    gradient: Array  # (p,)
    hessian: Array  # (p, p)
    curvature: Array  # (p, p) of the robust cost itself; the Hessian is that of the reweighted squares
    scatter: Array  # (p, p) of the gradients of single observations and priors
    spread: float  # robust standard deviation of the normalized residuals: 1 where the noise is right

    def weighted(self, share: float) -> RobustEquations:
        return RobustEquations(
            share * self.cost, share * self.gradient, share * self.hessian, share * self.curvature,
            share * self.scatter, self.spread,
        )  # fmt: skip

    def with_prior(self, value: Array, deviations: Array) -> RobustEquations:
        """Add a Gaussian prior about zero on the last unknowns, whose present values are ``value``."""
        first = len(self.gradient) - len(value)
        precision = deviations**-2
        information, gradient = np.zeros_like(self.hessian), self.gradient.copy()
        information[first:, first:] = np.diag(precision)
        gradient[first:] += precision * value
        cost = self.cost + 0.5 * float((precision * value**2).sum())
        return RobustEquations(
            cost, gradient, self.hessian + information, self.curvature + information,
            self.scatter + information, self.spread,
        )  # fmt: skip

    def covariance(self) -> Array:
        """Return the covariance of an M-estimator, ``A^-1 S A^-1`` with curvature A and scatter S (Huber 1981, 6.3)."""
        inverse = self.inverse_curvature()
        with np.errstate(over="ignore", invalid="ignore"):
            found: Array = inverse @ self.scatter @ inverse
            return (found + found.T) / 2

    def inverse_curvature(self) -> Array:
        """Return the inverse of the curvature: the covariance of the posterior in Laplace's approximation."""
        # With few residuals or many outliers the curvature may be indefinite; well-behaved residuals keep it near the Hessian.
        unit = 1 / np.sqrt(np.diag(self.hessian).clip(min=1e-300))
        values, vectors = np.linalg.eigh(unit[:, None] * self.curvature * unit)
        least = 0.2 * np.linalg.eigvalsh(unit[:, None] * self.hessian * unit)
        inverse = vectors @ np.diag(1 / np.maximum(values, least).clip(min=1e-12)) @ vectors.T
        # What the residuals do not determine at all overflows, so the covariance is not finite.
        with np.errstate(over="ignore", invalid="ignore"):
            found: Array = unit[:, None] * inverse * unit
            return found


def robust_spread(residual: Array, unknowns: int) -> float:
    """Return a robust standard deviation along an axis, corrected for the number of unknowns that were fitted."""
    spare = max(1.0, residual.size - unknowns) / residual.size
    return MAD_TO_SIGMA * _median(np.abs(residual).ravel()) / spare**0.5


def _median(values: Array) -> float:
    """Return ``np.median`` of finite values, without the checks that make it slow."""
    half, odd = divmod(len(values), 2)
    ordered = np.partition(values, (half - 1 + odd, half))
    return float(ordered[half]) if odd else float(0.5 * (ordered[half - 1] + ordered[half]))


def damped_solution(hessian: Array, damping: float, right: Array) -> Array:
    diagonal = np.diag(hessian).clip(min=1e-12)
    found: Array = np.linalg.solve(hessian + np.diag(damping * diagonal), right)
    return found
