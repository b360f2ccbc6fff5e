"""Estimation of a pose jointly from landmarks, measured points on the surface and rendered rays."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Generator, Tensor

from bidnerf_core.geometry import SE3, RobustName
from bidnerf_core.localization.costs.rendered import RenderedCost, RenderedCostSettings, Residuals
from bidnerf_core.localization.covariance import position_deviation, weight
from bidnerf_core.localization.depth_scale import (
    UNKNOWNS,
    PoseAndDepth,
    ScaledPoints,
    of_pose,
    residual_equations,
)
from bidnerf_core.localization.normal_equations import GaussianPrior, NormalEquations
from bidnerf_core.localization.problem import Problem
from bidnerf_core.localization.settings import (
    ColourSettings,
    DepthSettings,
    RefinementSettings,
    RefinementStage,
    rendered_depth_scale,
)
from bidnerf_core.localization.solvers.pivots import Pivot
from bidnerf_core.progress import check_stopped

LEAST_DECREASE = 0.1
"""Predicted decrease of the sum (a squared Mahalanobis distance) below which a step is the last."""
VAGUE = 1e3
"""Factor on the standard deviations of a prior that should have no influence."""
UNSURE = 2.0
"""Factor on the prior's standard deviation for the initial weights of the rays."""
FIRST_DAMPING = 1e-3
"""Damping of the first step."""


def drawn_rays(
    problem: Problem, rays: int, about: Pivot, generator: Generator, by_depth: bool = False, loss: RobustName = "geman-mcclure",
) -> RenderedCost:  # fmt: skip
    """Return the cost of drawn rays; the default colour loss is redescending, so occluders become outliers."""
    depth = DepthSettings() if problem.has_depth and by_depth else None
    colour = ColourSettings(colour_loss=loss)
    settings = RenderedCostSettings(colour, depth, RefinementSettings(exposure=True))
    stage = RefinementStage(0, rays, depth_scale=rendered_depth_scale(problem.bounds))
    return settings.drawn(problem, stage, about, generator)


@dataclass(frozen=True, eq=False)
class Measurements:
    """The measurements to fuse, with the number of independent ones of each kind."""

    prior: GaussianPrior  # on the pose, by landmarks
    points: ScaledPoints | None = None  # about the prior's pivot
    rays: RenderedCost | None = None  # about the same pivot
    independent_points: float = 0.0
    independent_rays: float = 0.0

    def at(self, state: PoseAndDepth, deviation: float) -> Fit:
        """Evaluate the measurements at a state, for which the scene's position is uncertain by ``deviation`` (metres)."""
        points, rays = None, None
        if self.points is not None:
            cost = self.points.at(state)
            equations, variance = cost.with_variance(state.T[None])
            equations = self.points.about_middle(cost, equations)
            points = Term(equations, float(variance[0]), self.independent_points)
        if self.rays is not None:
            rays = self.rays.residuals(state.T[None])
        return Fit(self, state, self._assumed(state), points, rays).weighed(deviation)

    def without_landmarks(self, start: SE3) -> Measurements:
        """Return the measurements without the landmarks' constraints, with a vague prior about another pose."""
        vague = replace(self.prior, mean=start, covariance=VAGUE**2 * self.prior.covariance)
        points = self.points
        if points is not None:
            points = replace(points, scale=replace(points.scale, by_landmarks=None), start=start)
        return replace(self, prior=vague, points=points)

    def _assumed(self, at: PoseAndDepth) -> NormalEquations:
        """Return the equations of the priors; without points, the errors of depth are fixed at 0."""
        by_prior = of_pose(self.prior(at.T[None]))
        if self.points is not None:
            return by_prior + self.points.assumed(at)
        unit = torch.eye(UNKNOWNS, dtype=torch.float64)
        return by_prior + residual_equations(0.0, unit[6], 1.0) + residual_equations(0.0, unit[7], 1.0)


@dataclass(frozen=True, eq=False)
class Term:
    """A kind of measurement at one state: the equations of its cost, the variance of its residuals, and its weight."""

    equations: NormalEquations
    variance: float
    measurements: float  # number of independent ones

    @property
    def weight(self) -> float:
        """Factor of the cost in the sum."""
        return weight(self.measurements, self.variance)


@dataclass(frozen=True, eq=False)
class Fit:
    """How well a state explains the measurements."""

    measurements: Measurements
    state: PoseAndDepth
    assumed: NormalEquations
    points: Term | None
    residuals: Residuals | None  # of the rays
    rays: Term | None = None

    def weighed(self, deviation: float) -> Fit:
        """Return the fit with the rays weighted for a position of the scene uncertain by ``deviation`` (metres)."""
        if self.residuals is None:
            return self
        residuals = replace(self.residuals, surface_sigma=deviation)
        equations = of_pose(residuals.normal_equations())
        term = Term(equations, float(residuals.variance()[0]), self.measurements.independent_rays)
        return replace(self, residuals=residuals, rays=term)

    @property
    def terms(self) -> tuple[Term, ...]:
        return tuple(term for term in (self.points, self.rays) if term is not None)

    @property
    def equations(self) -> NormalEquations:
        """The sum of all terms."""
        return sum((term.equations.scaled(term.weight) for term in self.terms), start=self.assumed)

    def cost(self, weighed: Fit) -> float:
        """Return the sum of all terms with the weights of another fit."""
        total = float(self.assumed.cost[0])
        pairs = zip(self.terms, weighed.terms, strict=True)
        return total + sum(there.weight * float(here.equations.cost[0]) for here, there in pairs)


@dataclass(frozen=True, eq=False)
class FusedPose:
    """A pose estimated from several kinds of measurements, with the depth scale and offset, and its covariance."""

    state: PoseAndDepth
    covariance: Float[Tensor, "6 6"]  # metres, radians; of a right update

    @property
    def T(self) -> SE3:
        return self.state.T


def nearby_start(
    measurements: Measurements, rays: RenderedCost, count: int, generator: Generator
) -> FusedPose:
    """Return the pose that explains prior and rays best, among the prior's mean and ``count`` draws from it.

    Refinement on rays converges only if rendered and observed edges overlap already, which the mean of a vague prior does not
    guarantee.
    """
    prior = measurements.prior
    root = UNSURE * torch.linalg.cholesky(prior.covariance)
    best = prior.mean
    for shrink in (1.0, 0.4):
        updates = torch.randn((count // 2, 6), generator=generator, dtype=torch.float64) @ (shrink * root).mT
        T = SE3.cat([best[None], best.retract(updates)])
        by_rays = rays.cost(T)
        total = prior(T).cost + weight(measurements.independent_rays, float(by_rays.min())) * by_rays
        best = T[int(total.argmin())]
    return FusedPose(PoseAndDepth(best), prior.covariance / 4)


def fused_pose(measurements: Measurements, most_steps: int, start: FusedPose | None = None) -> FusedPose:
    """Return the pose that minimizes the sum of all terms.

    The terms are reweighted by their residuals after each step, since weights from a distant start would remain too small. Rays
    whose rendering changes steeply within the uncertainty of the scene's position have less weight, since their linearization
    does not hold that far. A step that does not lower the sum is not taken. The iteration ends with a step that is short
    compared with the pose's standard deviation, or when the equations are not finite. The covariance includes the last step.
    """
    prior, damping = measurements.prior, torch.full((1,), FIRST_DAMPING, dtype=torch.float64)
    covariance = prior.at_pivot if start is None else start.covariance
    uncertain = UNSURE * position_deviation(covariance)
    here = measurements.at(PoseAndDepth(prior.mean) if start is None else start.state, uncertain)
    for _ in range(most_steps):
        check_stopped()
        equations = here.equations
        if not bool(equations.hessian.isfinite().all() & equations.gradient.isfinite().all()):
            break
        step = equations.solve(damping)
        state, last = here.state.moved(prior.pivot, step[0]), step[:, :6]
        covariance = torch.linalg.inv(equations.hessian[0])[:6, :6] + last.mT @ last
        deviation = position_deviation(covariance)
        if float(step[0] @ equations.hessian[0] @ step[0]) < LEAST_DECREASE and uncertain < 2 * deviation:
            here = replace(here, state=state)
            break
        uncertain = max(deviation, uncertain / 2)
        there = measurements.at(state, uncertain)
        lower = there.cost(here) < here.cost(here)
        here = there if lower else here.weighed(uncertain)
        damping = damping / 4 if lower else damping * 6
    covariance = prior.pivot.at_camera(here.state.T, covariance)
    return FusedPose(here.state, (covariance + covariance.mT) / 2)
