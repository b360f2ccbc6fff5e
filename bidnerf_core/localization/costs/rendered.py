"""The cost of rendered rays: comparison of the field's renderings from a pose with the measurements.

Rays are drawn once, with weights of their residuals that are the same for every pose.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Bool, Float
from torch import Generator, Tensor
from torch.nn.functional import avg_pool2d, interpolate

from bidnerf_core.devices import constant
from bidnerf_core.fields import (
    AroundDepth,
    HitField,
    HitsAroundDepth,
    Objective,
    Observations,
    RadianceField,
    Rays,
    Resampled,
)
from bidnerf_core.frames import DRAWERS, DrawerName, View, continued, draw
from bidnerf_core.geometry import SE3
from bidnerf_core.localization.costs.linearization import Linearization, linearize
from bidnerf_core.localization.exposure import EXPOSURE_ROUNDS, Exposure, clipped, robust_exposure
from bidnerf_core.localization.normal_equations import NormalEquations
from bidnerf_core.localization.problem import Problem
from bidnerf_core.localization.settings import (
    ColourSettings,
    DepthSettings,
    RefinementSettings,
    RefinementStage,
    objective_of,
)
from bidnerf_core.localization.solvers.pivots import Pivot

MISS_SCALES = 3.0
"""Depth residual, in depth scales, of a ray that hits nothing: that of an outlier, but less than the whole distance."""
LEAST_WITH_DEPTH = 0.05
"""Minimum fraction of rays with depth for these to represent all."""


@dataclass(frozen=True)
class RayCounts:
    """The numbers of rays to draw."""

    pixels: int  # in total, divided equally among the views
    depth_rays: int = 0  # in addition, from a sensor with rays of its own


@dataclass(frozen=True, eq=False)
class WeightedRays:
    """Measured rays in the last camera's frame, and the weights of their residuals in the objective."""

    observed: Observations  # (n)
    weights: Float[Tensor, "n c"]  # 0 where nothing was measured

    @cached_property
    def channels(self) -> tuple[int, ...]:
        """The channels that were measured along any ray."""
        used = (self.weights > 0).any(0).tolist()
        return tuple(channel for channel, is_used in enumerate(used) if is_used)


def draw_weighted_rays(
    problem: Problem,
    objective: Objective,
    counts: RayCounts,
    pixels: DrawerName,
    blur: int,
    generator: Generator,
) -> WeightedRays:
    """Draw pixels of all views and any depth rays, weighted as in eqs. 5 and 6.

    Colours are averaged over squares of ``blur`` x ``blur`` pixels; 1 leaves them unchanged.
    """
    views = [blurred(view, blur) for view in problem.views] if blur > 1 else problem.views
    seen = draw(views, counts.pixels, DRAWERS[pixels], generator, device=problem.device)
    observed, weights = seen.flattened(), objective.weights(seen).flatten(0, 1)
    if problem.depth_rays is None or not objective.uses_depth or counts.depth_rays == 0:
        return WeightedRays(observed, weights)
    own = problem.depth_rays.drawn(counts.depth_rays, generator, device=problem.device)
    weights = torch.cat([weights, objective.weights(own[None]).flatten(0, 1)])
    return WeightedRays(Observations.joined([observed, own]), weights)


def blurred(view: View, size: int) -> View:
    """Return the view with colours averaged over squares of ``size`` pixels and interpolated between; depth is unchanged."""
    frame = view.frame
    height, width = frame.rgb_bytes.shape[:2]
    size = min(size, height, width)
    small = avg_pool2d(continued(frame).permute(2, 0, 1)[None], size, ceil_mode=True, count_include_pad=False)
    # Enlarged to whole squares, then cropped to the image, so that squares stay in place.
    covered = (small.shape[2] * size, small.shape[3] * size)
    smooth = interpolate(small, covered, mode="bilinear", align_corners=False)[..., :height, :width]
    return replace(view, frame=replace(frame, rgb=smooth[0].permute(1, 2, 0).contiguous()))


@dataclass(frozen=True, eq=False)
class Residuals:
    """Rendered minus measured, for each of n rays from each of h poses, c channels each; float64."""

    value: Float[Tensor, "h n c"]
    jacobian: Float[Tensor, "h n c 6"]
    weights: Float[Tensor, "n c"]  # of each in the objective; 0 where nothing was measured
    steepness: Float[Tensor, "h n c"]  # norm of its gradient with respect to the ray's origin, per metre
    surface_sigma: float  # metres: uncertainty of the scene's position, due to errors of the map or the pose
    objective: Objective
    home: torch.device = torch.device("cpu")  # device of the poses, on which results are returned

    @cached_property
    def confidence(self) -> Float[Tensor, "h n c"]:
        """1, or less for residuals too steep for the scene's uncertainty, which adds a variance of (steepness x sigma)^2."""
        scales = constant(tuple(self.objective.scales), self.value)
        return (1 + (self.surface_sigma / scales * self.steepness) ** 2).rsqrt()

    @property
    def _pull(self) -> Float[Tensor, "h n c"]:
        """Weight of each squared residual in a step."""
        return self.weights * self.confidence**2 * self.objective.robust_weights(self.confidence * self.value)

    def cost(self) -> Float[Tensor, "h"]:
        """Return ``2 sum weight rho(r)``, the plain weighted sum of squares if residuals are small.

        The confidence weights the equations of a step, but not this cost. Otherwise, a step could lower the cost by moving rays
        to where residuals are steep and their confidence is low.
        """
        return self.ray_costs().sum(-1)

    def ray_costs(self) -> Float[Tensor, "h n"]:
        """Return each ray's part of the cost."""
        return 2 * (self.weights * self.objective.rho(self.value)).sum(-1).to(self.home)

    def normal_equations(self) -> NormalEquations:
        """Return the equations of iteratively reweighted least squares."""
        pull = self._pull
        return NormalEquations(
            self.cost(),
            torch.einsum("hnc,hnci->hi", pull * self.value, self.jacobian).to(self.home),
            torch.einsum("hnc,hnci,hncj->hij", pull, self.jacobian, self.jacobian).to(self.home),
        )

    def scores(self) -> Float[Tensor, "h n 6"]:
        """Return each ray's contribution to the gradient."""
        return torch.einsum("hnc,hnci->hni", self._pull * self.value, self.jacobian).to(self.home)

    def variance(self) -> Float[Tensor, "h"]:
        """Return the variance of a residual with respect to the pose, ignoring uninformative rays such as those on a background.

        For n independent rays, the pose's covariance would be this times the inverse of the Hessian, divided by n.
        """
        hessian, scores = self.normal_equations().hessian, self.scores()
        scores = scores - scores.mean(1, keepdim=True)  # the remaining mean gradient is not noise
        unit = hessian.diagonal(dim1=-2, dim2=-1).clamp(min=1e-300).rsqrt()[..., None]
        inverse = torch.linalg.pinv(unit * hessian * unit.mT, rtol=1e-10, hermitian=True)
        spread = (unit * (scores.mT @ scores) * unit.mT * inverse).sum((-2, -1))
        return scores.shape[1] / 6 * spread

    def inliers(self) -> Float[Tensor, "h"]:
        """Return the fraction of rays with all residuals within three times the scale at which outliers begin."""
        return self._agreeing.double().mean(-1).to(self.home)

    def inliers_by_depth(self) -> Float[Tensor, "h"]:
        """Return the inlier fraction of the rays with depth, or of all rays if less than ``LEAST_WITH_DEPTH`` have it.

        This excludes occluders without depth, which may be too close for the sensor, too dark or too transparent.
        """
        measured = (self.weights[:, 3:] > 0).any(-1).double()
        agreeing = self._agreeing.double()
        share = (agreeing * measured).sum(-1) / measured.sum().clamp(min=1)
        some = measured.mean() >= LEAST_WITH_DEPTH
        return torch.where(some, share, agreeing.mean(-1)).to(self.home)

    @property
    def _agreeing(self) -> Bool[Tensor, "h n"]:
        limits = constant(tuple(self.objective.scales), self.value)
        return ~((self.value.abs() > 3 * limits) & (self.weights > 0)).any(-1)


@dataclass(frozen=True, eq=False)
class RenderedCost:
    """The objective on one draw of rays, at a stage's level of detail."""

    problem: Problem
    rays: WeightedRays
    objective: Objective
    stage: RefinementStage
    settings: RefinementSettings
    pivot: Pivot

    def __call__(self, T: SE3) -> NormalEquations:
        return self.residuals(T).normal_equations()

    def cost(self, T: SE3) -> Float[Tensor, "h"]:
        """Return the cost alone, without computing derivatives."""
        return self.residuals(T, derivatives=False).cost()

    def residuals(self, T: SE3, derivatives: bool = True) -> Residuals:
        """Return the residuals at poses T (h); without ``derivatives``, their Jacobian is 0."""
        home, device = T.translation.device, self.rays.weights.device
        T, channels = T.to(device), self.rays.channels if derivatives else ()
        rays = self.rays.observed.rays(T, self.problem.bounds)
        found = linearize(
            self._field(rays), rays, self.rays.observed, self.objective.residuals, self.pivot.to(device).at(T),
            self.problem.bounds.background, self.settings.least_weight, channels,
        )  # fmt: skip
        residuals = _residuals(
            found, self.rays, self.objective, self.settings.exposure, self.stage.surface_sigma
        )
        return replace(residuals, home=home)

    def ray_costs(self, T: SE3) -> Float[Tensor, "h n"]:
        """Return each ray's part of the cost, without computing derivatives."""
        return self.residuals(T, derivatives=False).ray_costs()

    def plain_ray_costs(self) -> Float[Tensor, "n"] | None:
        """Return each ray's part of the cost for images with the single best-fitting colour; on the CPU.

        None if depth was measured too, or if no colour was.
        """
        weights, rgb = self.rays.weights.double(), self.rays.observed.rgb.double()
        if bool((weights[:, 3:] > 0).any()) or not bool((weights[:, :3] > 0).any()):
            return None
        robust, share = self.objective.terms[0].robust, weights[:, :3]
        mean = (share * rgb).sum(0) / weights[:, :3].sum(0)
        for _ in range(EXPOSURE_ROUNDS):
            share = weights[:, :3] * robust.weight(rgb - mean)
            mean = (share * rgb).sum(0) / share.sum(0)
        value = torch.zeros_like(weights)
        value[:, :3] = torch.where(weights[:, :3] > 0, mean - rgb, 0)
        return 2 * (weights * self.objective.rho(value)).sum(-1).cpu()

    @property
    def field(self) -> RadianceField:
        """The stage's level of detail."""
        return self.problem.level(self.stage.level)

    def _field(self, rays: Rays) -> RadianceField:
        """Return the stage's level, sampled only around the measured depth if the stage has a window."""
        if self.stage.window == 0:
            return self.field
        distance = self.rays.observed.distance.expand(rays.near.shape).flatten()
        if isinstance(self.field, HitField):
            return HitsAroundDepth(self.field, distance, self.stage.window)
        count = self.settings.window_samples
        return Resampled(self.field, AroundDepth(distance, self.stage.window, count, self.field.sampler))


@dataclass(frozen=True)
class RenderedCostSettings:
    """The settings of the rendered cost that are common to all stages of a refinement."""

    colour: ColourSettings
    depth: DepthSettings | None  # None: colour alone
    refinement: RefinementSettings

    def drawn(
        self, problem: Problem, stage: RefinementStage, pivot: Pivot, generator: Generator
    ) -> RenderedCost:
        """Draw the rays of a stage and return the cost on them."""
        depth = self.depth
        objective = objective_of(self.colour, depth, stage.colour_scale, stage.depth_scale, MISS_SCALES)
        counts = RayCounts(stage.rays, 0 if depth is None else depth.depth_rays)
        rays = draw_weighted_rays(problem, objective, counts, self.refinement.pixels, stage.blur, generator)
        _ = rays.channels  # computed here, since the host waits for it
        return RenderedCost(problem, rays, objective, stage, self.refinement, pivot)


def _residuals(
    found: Linearization, rays: WeightedRays, objective: Objective, exposure: bool, surface_sigma: float
) -> Residuals:
    """Convert a linearization to weighted residuals; with ``exposure``, the rendering is first corrected to the image's exposure.

    The correction clips colours at black and white, as cameras do; a clipped residual does not depend on the pose.
    """
    value, jacobian, weights = found.residuals.double(), found.jacobian.double(), rays.weights.double()
    if exposure:
        rendered, measured = found.rgb.double(), rays.observed.rgb.double()
        fitted = robust_exposure(rendered.mT, measured.mT, weights[:, :3].mT, objective.terms[0].robust)
        seen = fitted.applied(rendered.mT).mT
        inside = ((seen - 0.5).abs() < 0.5)[..., None]
        value = torch.cat([seen.clamp(0, 1) - measured, value[..., 3:]], -1)
        telling = weights[:, :3] * ~clipped(seen, measured)
        by_colour = inside * _without_exposure(rendered, inside * jacobian[..., :3, :], telling, fitted)
        jacobian = torch.cat([by_colour, jacobian[..., 3:, :]], -2)
    value, steepness = torch.where(weights > 0, value, 0), found.steepness.double()
    return Residuals(value, jacobian, weights, steepness, surface_sigma, objective)


def _without_exposure(
    rendered: Float[Tensor, "h n 3"], jacobian: Float[Tensor, "h n 3 6"], weights: Float[Tensor, "h n 3"], fitted: Exposure
) -> Float[Tensor, "h n 3 6"]:  # fmt: skip
    """Return the colours' Jacobian with the exposure eliminated: gain and bias are projected out (variable projection)."""
    by_pose = fitted.gain[:, None, :, None] * jacobian
    share = weights / weights.sum(1, keepdim=True).clamp(min=torch.finfo(weights.dtype).tiny)
    basis = rendered - (share * rendered).sum(1, keepdim=True)
    basis = basis * (share * basis**2).sum(1, keepdim=True).clamp(min=1e-12).rsqrt()
    by_pose = by_pose - torch.einsum("hnc,hnci->hci", share, by_pose)[:, None]
    return by_pose - basis[..., None] * torch.einsum("hnc,hnc,hnci->hci", share, basis, by_pose)[:, None]
