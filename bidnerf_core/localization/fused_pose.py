"""The pose that explains best a prior, measured points on the surface and rendered rays together."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.localization.costs.prior import GaussianPrior
from bidnerf_core.localization.costs.rendered import RenderedCost
from bidnerf_core.localization.costs.surface import SurfaceCost
from bidnerf_core.localization.covariance import INDEPENDENT, LEAST_VARIANCE, position_deviation
from bidnerf_core.localization.depth_scale import JointEquations, PoseAndFactor, ScaledPoints
from bidnerf_core.localization.fusion import RENDERED_MEASUREMENTS
from bidnerf_core.se3 import SE3

POINT_MEASUREMENTS = 30.0
"""Number of independent measurements that a view's points count as where their scale is estimated."""
SETTLED = 0.3
"""Squared length of a step, in standard deviations of the pose, below which there is no other step."""
SMOOTHING = 0.5
"""Share of the pose's standard deviation that counts as uncertainty of the surfaces in rendered rays."""
DAMPING = 1e-3
"""Damping of the first step."""


@dataclass(frozen=True, eq=False)
class FusedTerms:
    """What is fused: a prior of the pose, measured points, and rendered rays, of which fresh ones are drawn for each step."""

    prior: GaussianPrior
    views: int
    points: ScaledPoints | None = None  # about the prior's pivot
    # Returns the cost of fresh rays, about that pivot too, from a pose and for an uncertainty of the surfaces, metres.
    draw: Callable[[SE3, float], RenderedCost] | None = None
    effort: float = 1.0  # how many times each rendered ray counts

    def at(self, here: PoseAndFactor, deviation: float) -> WeighedTerms:
        """Weigh the terms by how well they fit a pose whose position has that standard deviation, metres."""
        points = rays = None
        if self.points is not None:
            cost = self.points.at(here.factor)
            equations, variance = cost.with_variance(here.T[None])
            weight = POINT_MEASUREMENTS * self.views / max(float(variance[0]), LEAST_VARIANCE)
            joint = self.points.joint(cost, equations)
            points = WeighedEquations(cost, joint, weight, INDEPENDENT / (POINT_MEASUREMENTS * self.views))
        if self.draw is not None:
            drawn = self.draw(here.T, SMOOTHING * deviation)
            equations = drawn(here.T[None])
            count = self.effort * RENDERED_MEASUREMENTS * self.views
            weight = count / max(float(equations.cost[0]), LEAST_VARIANCE)
            rays = WeighedEquations(drawn, JointEquations.of_pose(equations), weight, INDEPENDENT / count)
        return WeighedTerms(self, here, points, rays)


@dataclass(frozen=True, eq=False)
class WeighedEquations:
    """A cost with its equations at one pose, and its factor in the sum."""

    cost: SurfaceCost | RenderedCost
    joint: JointEquations
    weight: float
    independent: (
        float  # share of the weight that counts in the covariance, since errors are correlated in an image
    )

    def counted(self, independent: bool) -> float:
        """Return the factor in the sum, or in the information of which the covariance is the inverse."""
        return self.weight * (self.independent if independent else 1.0)


@dataclass(frozen=True, eq=False)
class WeighedTerms:
    """The terms at a pose and a depth factor, each with its weight there."""

    terms: FusedTerms
    here: PoseAndFactor
    points: WeighedEquations | None
    rays: WeighedEquations | None

    def equations(self, independent: bool = False) -> JointEquations:
        """Return the sum of all terms; with ``independent`` they count as in the covariance."""
        total = JointEquations.of_pose(self.terms.prior(self.here.T[None])) + self._of_factor(self.here)
        if self.points is not None:
            total = total + self.points.joint.scaled(self.points.counted(independent))
        if self.rays is not None:
            total = total + self.rays.joint.scaled(self.rays.counted(independent))
        return total

    def cost(self, at: PoseAndFactor) -> float:
        """Return the sum of all terms elsewhere, on the same rays and with the same weights."""
        T = at.T[None]
        total = float(self.terms.prior(T).cost[0]) + self._of_factor(at).cost
        if self.points is not None and self.terms.points is not None:
            total += self.points.weight * float(self.terms.points.at(at.factor).cost(T)[0])
        if self.rays is not None:
            total += self.rays.weight * float(self.rays.cost.cost(T)[0])
        return total

    def _of_factor(self, at: PoseAndFactor) -> JointEquations:
        """Return what is assumed of the depth factor; that it is 1 where no points were measured."""
        if self.terms.points is not None:
            return self.terms.points.assumed(at)
        return JointEquations.of_residual(at.factor - 1, torch.eye(7, dtype=torch.float64)[6], 1.0)


def fused_pose(terms: FusedTerms, most_steps: int) -> tuple[SE3, Float[Tensor, "6 6"]]:
    """Return the pose that explains all terms best, and its covariance (metres, radians; of a right update).

    Each step takes fresh rays, so that the pose does not fit the noise of one draw, and weighs the terms by how well they fit
    before it: a start that is far off would make them count for little to the end. Rays whose rendering changes steeply over
    the distance by which the pose may be off count for less, since their derivatives do not hold so far. A step that does not
    lower the sum is not taken. The factor of measured depths is estimated too. The covariance allows for the last step.
    """
    prior = terms.prior
    here, covariance = PoseAndFactor(prior.mean), prior.covariance
    damping = torch.full((1,), DAMPING, dtype=torch.float64)
    for _ in range(most_steps):
        weighed = terms.at(here, position_deviation(covariance))
        joint = weighed.equations()
        equations = joint.without_factor()
        step = equations.solve(damping)
        trial = prior.pivot.moved(here.T[None], step)[0].normalized()
        there = PoseAndFactor(trial, here.factor + joint.factor_step(step[0]))
        information = weighed.equations(independent=True).without_factor().hessian[0]
        covariance = prior.pivot.at_camera(here.T, torch.linalg.inv(information) + step.mT @ step)
        lower = weighed.cost(there) < joint.cost
        here = there if lower else here
        damping = damping / 4 if lower else damping * 6
        if float(step[0] @ equations.hessian[0] @ step[0]) < SETTLED:
            break
    return here.T, (covariance + covariance.mT) / 2
