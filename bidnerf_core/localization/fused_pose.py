"""The pose that best explains a prior, measured points on the surface and rendered rays together."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.geometry.se3 import SE3
from bidnerf_core.localization.costs.prior import GaussianPrior
from bidnerf_core.localization.costs.rendered import RenderedCost
from bidnerf_core.localization.covariance import INDEPENDENT, LEAST_VARIANCE, position_deviation
from bidnerf_core.localization.depth_scale import (
    PoseAndFactor,
    ScaledPoints,
    residual_equations,
    with_factor,
)
from bidnerf_core.localization.fusion import RENDERED_MEASUREMENTS, SCALED_MEASUREMENTS
from bidnerf_core.localization.normal_equations import NormalEquations

LEAST_DECREASE = 0.3
"""Predicted decrease of the sum of all terms below which a step is the last."""
FIRST_DAMPING = 1e-3
"""Damping of the first step."""


@dataclass(frozen=True, eq=False)
class Measurements:
    """What is fused: a prior on the pose, measured points, and rendered rays, which are drawn anew for each step."""

    prior: GaussianPrior
    views: int
    points: ScaledPoints | None = None  # about the prior's pivot
    # Returns the cost of fresh rays, about that pivot too, given a pose and the uncertainty of the surfaces (metres).
    draw: Callable[[SE3, float], RenderedCost] | None = None
    effort: float = 1.0  # factor on the weight of the rendered rays together

    def at(self, here: PoseAndFactor, deviation: float) -> WeightedTerms:
        """Weight the terms by how well they fit a pose; what is seen from it is uncertain by ``deviation`` (metres)."""
        terms = []
        if self.points is not None:
            cost = self.points.at(here.factor)
            equations, variance = cost.with_variance(here.T[None])
            equations = self.points.about_middle(cost, equations)
            terms.append(
                WeightedTerm(
                    self.points.cost_at, equations, float(variance[0]), SCALED_MEASUREMENTS * self.views
                )
            )
        if self.draw is not None:
            rays = self.draw(here.T, deviation)
            equations = with_factor(rays(here.T[None]))
            count = self.effort * RENDERED_MEASUREMENTS * self.views
            terms.append(
                WeightedTerm(lambda at: rays.cost(at.T[None]), equations, float(equations.cost[0]), count)
            )
        return WeightedTerms(self, self.assumed(here), tuple(terms))

    def assumed(self, at: PoseAndFactor) -> NormalEquations:
        """Return the equations of what is known besides the measurements, about the pose and about the factor on depths.

        Without points the factor is tied to 1, so that the equations can be solved.
        """
        by_prior = with_factor(self.prior(at.T[None]))
        if self.points is not None:
            return by_prior + self.points.assumed(at)
        return by_prior + residual_equations(at.factor - 1, torch.eye(7, dtype=torch.float64)[6], 1.0)


@dataclass(frozen=True, eq=False)
class WeightedTerm:
    """A cost with its equations at one pose and factor, and the variance of its residuals there."""

    cost: Callable[[PoseAndFactor], Float[Tensor, "1"]]
    equations: NormalEquations
    variance: float
    measurements: float  # number of independent measurements that it counts as in a step

    @property
    def weight(self) -> float:
        """Factor of the cost in the sum."""
        return self.measurements / max(self.variance, LEAST_VARIANCE)

    @property
    def information(self) -> NormalEquations:
        """The equations as they count in the covariance: errors are correlated over an image, and from image to image."""
        return self.equations.scaled(INDEPENDENT / max(self.variance, LEAST_VARIANCE))


@dataclass(frozen=True, eq=False)
class WeightedTerms:
    """The measurements at a pose and a depth factor, each with its weight there."""

    measurements: Measurements
    assumed: NormalEquations
    terms: tuple[WeightedTerm, ...]

    @property
    def equations(self) -> NormalEquations:
        """The sum of all terms."""
        return sum((term.equations.scaled(term.weight) for term in self.terms), start=self.assumed)

    @property
    def information(self) -> Float[Tensor, "6 6"]:
        """The inverse of the pose's covariance, about the prior's pivot."""
        whole = sum((term.information for term in self.terms), start=self.assumed)
        return whole.without_last().hessian[0]

    def cost(self, at: PoseAndFactor) -> float:
        """Return the sum of all terms elsewhere, on the same rays and with the same weights."""
        total = float(self.measurements.assumed(at).cost[0])
        return total + sum(term.weight * float(term.cost(at)[0]) for term in self.terms)


@dataclass(frozen=True, eq=False)
class FusedPose:
    """A pose estimated from several measurements, its covariance, and the factor on measured depths estimated with it."""

    T: SE3
    covariance: Float[Tensor, "6 6"]  # metres, radians; of a right update
    factor: float


def fused_pose(measurements: Measurements, most_steps: int) -> FusedPose:
    """Return the pose that explains all terms best.

    Each step takes fresh rays, so that the pose does not fit the noise of one draw, and weights the terms anew by how well they
    fit before it: with weights from a start that is far off, they would count for little until the end. Rays whose rendering
    changes steeply over the distance by which what is seen may be off count less, since their linearization does not hold that
    far. A step that does not lower the sum is not taken, and the steps end where equations are not finite. The covariance
    allows for the last step.
    """
    prior = measurements.prior
    here, covariance = PoseAndFactor(prior.mean), prior.at_pivot
    damping = torch.full((1,), FIRST_DAMPING, dtype=torch.float64)
    for _ in range(most_steps):
        weighted = measurements.at(here, position_deviation(covariance))
        equations, information = weighted.equations, weighted.information
        if not bool(equations.hessian.isfinite().all() & equations.gradient.isfinite().all()):
            break
        of_pose = equations.without_last()
        step = of_pose.solve(damping)
        there = PoseAndFactor(
            prior.pivot.moved(here.T[None], step)[0].normalized(),
            here.factor + float(equations.best_last(step)[0]),
        )
        covariance = torch.linalg.inv(information) + step.mT @ step
        lower = weighted.cost(there) < float(equations.cost[0])
        here = there if lower else here
        damping = damping / 4 if lower else damping * 6
        if float(step[0] @ of_pose.hessian[0] @ step[0]) < LEAST_DECREASE:
            break
    covariance = prior.pivot.at_camera(here.T, covariance)
    return FusedPose(here.T, (covariance + covariance.mT) / 2, here.factor)
