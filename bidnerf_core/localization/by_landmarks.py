"""Poses by landmarks: match the query's features with the map's, then fuse with measured depth and rendered rays."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Generator, Tensor

from bidnerf_core.localization.acceptance import landmark_verdict
from bidnerf_core.localization.costs.prior import GaussianPrior
from bidnerf_core.localization.costs.rendered import RenderedCostSettings
from bidnerf_core.localization.costs.surface import PointCloud, PointScales, SurfaceCost
from bidnerf_core.localization.covariance import FINEST, INDEPENDENT, LEAST_VARIANCE
from bidnerf_core.localization.method_settings import (
    ColourSettings,
    DepthSettings,
    RefinementSettings,
    RefinementStage,
)
from bidnerf_core.localization.normal_equations import Cost, Scaled, Sum
from bidnerf_core.localization.pivots import Pivot, pivot
from bidnerf_core.localization.problem import Problem
from bidnerf_core.localization.result import Localization
from bidnerf_core.localization.search.landmarks import LandmarkPose, propose
from bidnerf_core.localization.search.matching import LandmarkMatcher
from bidnerf_core.localization.solvers.levenberg_marquardt import descend
from bidnerf_core.se3 import SE3

POINTS = 2000
"""Largest number of measured points that are fused."""
SURFACE_MEASUREMENTS, RENDERED_MEASUREMENTS = 10.0, 300.0
"""Numbers of independent measurements that a view's points on the surface and its rendered rays count as."""
FUSION_STEPS = 6
"""Number of second-order steps on the sum of all terms."""
SHARPEST = 0.04
"""Colour noise of a field on its own training images (root mean square) above which rendering adds nothing to landmarks."""
INFLATION = 3.0
"""Factor on the covariance of a pose by landmarks, which treats the errors of keypoints and of the map's poses as
independent, although they are correlated within an image. It was set by the normalised errors of a fifth of the test images
of four scenes.
"""
FOCAL_OFF, FOCAL_NOISE = 0.03, 2.0
"""Limits beyond which the given focal length is taken to be wrong: the logarithm of the estimated factor, and the ratio of
the reprojection noise with the given focal length to that with the estimated one.
"""
FOCAL_PRIOR, FOCAL_ESTIMATED = 0.003, 0.01
"""Relative standard deviations of a calibrated focal length and of one that was estimated with the pose. The random error of
the latter is part of the fit's covariance, but errors of the lens model and the landmarks bias it by a percent or more.
"""
DEPTH_SCALE_PRIOR = 0.02
"""Relative standard deviation of a depth sensor's scale."""


@dataclass(frozen=True, eq=False)
class FusedTerm:
    """A cost with the variance of its residuals, so that costs in different units can be added."""

    cost: Cost
    variance: float
    measurements: float  # independent ones that it counts for

    @property
    def scaled(self) -> Cost:
        return Scaled(self.cost, self.measurements / self.variance)


@dataclass(frozen=True, eq=False)
class LandmarkAnswer:
    """A pose by landmarks, and the pose after fusing it with the other measurements."""

    found: LandmarkPose
    T: SE3
    covariance: Float[Tensor, "6 6"]
    terms: tuple[str, ...]  # what was fused with the landmarks


def answer_by_landmarks(
    problem: Problem, matcher: LandmarkMatcher, rays: int, seed: int
) -> LandmarkAnswer | None:
    """Find the pose by landmarks and refine it on all terms at once. Returns None if too few features match.

    ``rays`` is the number of rays rendered for the refinement; 0 leaves rendering out.
    """
    found = _found(problem, matcher, seed)
    if found is None:
        return None
    problem = replace(problem, start=found.T_world_camera)
    about, terms = pivot("scene", problem), dict[str, FusedTerm]()
    generator = Generator().manual_seed(seed)
    if abs(found.focal_factor - 1) < 1e-3:  # other terms would need the corrected camera
        if problem.surface is not None and problem.has_depth:
            terms["depth"] = _surface_term(problem, found, generator)
        if rays and matcher.landmarks is not None and _is_sharp(problem):
            terms["rendering"] = _rendered_term(problem, rays, about, generator)
    return _fused(found, terms, about)


def _found(problem: Problem, matcher: LandmarkMatcher, seed: int) -> LandmarkPose | None:
    """Find the pose with the given focal length, or estimate the focal length if it is only nominal or does not fit."""
    views = problem.views
    if len(views) == 1 and views[0].frame.focal_is_approximate:
        return propose(matcher, views, seed=seed, unknown_focal=True)
    found = propose(matcher, views, seed=seed)
    check = None if found is None else found.focal_check
    if found is None or check is None:
        return found
    if abs(math.log(check.factor)) <= FOCAL_OFF or found.noise <= FOCAL_NOISE * check.noise:
        return found
    return propose(matcher, views, seed=seed, unknown_focal=True) or found


def _pose_covariance(found: LandmarkPose) -> Float[Tensor, "6 6"]:
    """Return the covariance of a pose by landmarks, including the uncertainty of the focal length."""
    covariance = INFLATION * found.map_covariance
    if found.focal_check is None:
        return covariance
    sigma = FOCAL_PRIOR if found.focal_factor == 1 else FOCAL_ESTIMATED
    slope = found.focal_check.slope
    return covariance + sigma**2 * slope[:, None] * slope


def _is_sharp(problem: Problem) -> bool:
    return problem.colour_noise is None or problem.colour_noise <= SHARPEST


def _surface_term(problem: Problem, found: LandmarkPose, generator: Generator) -> FusedTerm:
    """Return the term of measured points on the surface, after correcting the scale of measured depth."""
    assert problem.surface is not None
    cloud = PointCloud.measured(problem.views, problem.depth_rays, POINTS, generator)
    cloud = replace(cloud, points=cloud.origins + _depth_scale(found) * (cloud.points - cloud.origins))
    scales = PointScales(FINEST * problem.surface.cell)
    cost = SurfaceCost(problem.surface, cloud, scales)
    variance = max(float(cost.residual_variance(found.T_world_camera[None])[0]), LEAST_VARIANCE)
    return FusedTerm(cost, variance, SURFACE_MEASUREMENTS * len(problem.views))


def _depth_scale(found: LandmarkPose) -> float:
    """Return the factor on measured depth that landmarks give, shrunk towards 1 by the prior; 1 if they give none."""
    if found.depth_scale is None:
        return 1.0
    # This is about the variance of a median over a few landmarks.
    variance = 0.01**2
    weight = DEPTH_SCALE_PRIOR**2 / (DEPTH_SCALE_PRIOR**2 + variance)
    return 1 + weight * (found.depth_scale - 1)


def _rendered_term(problem: Problem, rays: int, about: Pivot, generator: Generator) -> FusedTerm:
    """Return the term that compares rendered rays with the images."""
    cell = 0.01 if problem.surface is None else problem.surface.cell
    stage = RefinementStage(FUSION_STEPS, rays, depth_scale=6 * cell)
    depth = DepthSettings() if problem.has_depth else None
    settings = RenderedCostSettings(
        ColourSettings(), depth, RefinementSettings(exposure=problem.exposure_varies)
    )
    cost = settings.drawn(problem, stage, about, generator)
    assert problem.start is not None
    variance = max(float(cost.cost(problem.start[None])[0]), LEAST_VARIANCE)
    return FusedTerm(cost, variance, RENDERED_MEASUREMENTS * len(problem.views))


def _fused(found: LandmarkPose, terms: dict[str, FusedTerm], about: Pivot) -> LandmarkAnswer:
    """Minimize the sum of the landmarks' Gaussian prior and the other terms, and return the fused pose.

    The covariance counts each additional term as only ``INDEPENDENT`` measurements, because its errors are correlated over
    large parts of an image.
    """
    covariance = _pose_covariance(found)
    if not terms:
        return LandmarkAnswer(found, found.T_world_camera, covariance, ())
    prior = GaussianPrior(found.T_world_camera, covariance, about)
    cost = Sum((prior, *(term.scaled for term in terms.values())))
    done = descend(cost, found.T_world_camera[None], FUSION_STEPS, about.moved)
    T = done.T[0].normalized()
    information = prior(T[None]).hessian[0]
    for term in terms.values():
        information = information + term.cost(T[None]).hessian[0] * (INDEPENDENT / term.variance)
    covariance = about.at_camera(T, torch.linalg.inv(information))
    return LandmarkAnswer(found, T, (covariance + covariance.mT) / 2, tuple(terms))


def localization_by_landmarks(problem: Problem, answer: LandmarkAnswer, began: float) -> Localization:
    """Return an answer as a localization of method ``auto``."""
    found, verdict = answer.found, landmark_verdict(answer.found)
    poses = [found.T_world_camera, answer.T]
    if problem.start is not None:
        poses = [problem.start, *poses]
    fused = f", fused with {' and '.join(answer.terms)}" if answer.terms else ""
    return Localization(
        T_world_camera=answer.T,
        outcome=verdict.outcome,
        reason=verdict.reason + fused,
        steps=len(poses) - 1,
        seconds=time.perf_counter() - began,
        loss=found.noise,
        method="auto",
        poses=SE3.stack(poses),
        losses=torch.full((len(poses) - 1,), found.noise, dtype=torch.float64),
        covariance=answer.covariance,
        focal_factor=found.focal_factor,
    )
