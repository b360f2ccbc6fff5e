"""Poses by landmarks: match the query's features with the map's, then fuse with measured depth and rendered rays."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Generator, Tensor

from bidnerf_core.camera import Intrinsics
from bidnerf_core.depth_sensor import DepthSensorModel
from bidnerf_core.localization.acceptance import (
    LandmarkDiagnostics,
    LandmarkThresholds,
    doubtful_intrinsics,
    landmark_diagnostics,
    landmark_verdict,
)
from bidnerf_core.localization.confidence import TRUSTED, judged
from bidnerf_core.localization.costs.prior import GaussianPrior
from bidnerf_core.localization.costs.rendered import RenderedCostSettings
from bidnerf_core.localization.costs.surface import PointCloud, SurfaceCost
from bidnerf_core.localization.covariance import INDEPENDENT
from bidnerf_core.localization.fusion import FusedTerm, finest_cost, rendered_term, surface_term
from bidnerf_core.localization.method_settings import (
    ColourSettings,
    DepthSettings,
    RefinementSettings,
    RefinementStage,
    rendered_depth_scale,
)
from bidnerf_core.localization.normal_equations import Sum
from bidnerf_core.localization.pivots import Pivot, pivot
from bidnerf_core.localization.problem import Problem
from bidnerf_core.localization.rendered_evidence import log_odds_by_rendering
from bidnerf_core.localization.result import Localization, Outcome, Verdict
from bidnerf_core.localization.search.landmark_pose import LandmarkPose
from bidnerf_core.localization.search.landmarks import propose
from bidnerf_core.localization.search.map_camera import map_camera
from bidnerf_core.localization.search.matching import LandmarkMatcher
from bidnerf_core.localization.search.miscalibration import NO_EVIDENCE, CameraEvidence
from bidnerf_core.localization.solvers.levenberg_marquardt import descend
from bidnerf_core.mapping import SurfaceMap
from bidnerf_core.mapping.calibration import Calibration
from bidnerf_core.se3 import SE3

POINTS = 2000
"""Largest number of measured points that are fused."""
FUSION_STEPS = 2
"""Number of second-order steps on the sum of all terms."""
THOROUGHLY = 4
"""How many times as many rays and steps poses get that landmarks leave doubtful; each ray then counts so many times as much."""
SHARPEST = 0.04
"""Colour noise of a field on its own training images (root mean square) above which rendering adds nothing to landmarks."""
DEPTH_SCALE_NOISE = 0.01
"""Relative standard deviation of the depth scale that a few landmarks give."""
MOSTLY = 0.5
"""Least share of the measured points on the surface with which a scene is not taken to be partly hidden."""
PRIOR_WIDTH = 2.0
"""Standard deviation of the prior of the depth scale over that of the sensor's scale, since single sensors are off by far more."""


@dataclass(frozen=True, eq=False)
class LandmarkAnswer:
    """A pose by landmarks, the pose after fusing it with the other measurements, and whether to accept it."""

    found: LandmarkPose
    verdict: Verdict
    T: SE3
    covariance: Float[Tensor, "6 6"]
    diagnostics: LandmarkDiagnostics
    terms: tuple[str, ...] = ()  # what was fused with the landmarks
    confidence: float | None = None  # probability that the pose is right

    @property
    def full_covariance(self) -> Float[Tensor, "6 6"]:
        """The covariance with the errors of the intrinsics that the image does not rule out.

        Landmarks and rendered colours are misled by them alike, and the scale of measured depth is no better known.
        """
        return self.covariance + self.found.unresolved_calibration


def answer_by_landmarks(
    problem: Problem, matcher: LandmarkMatcher, rays: int, seed: int
) -> LandmarkAnswer | None:
    """Find the pose by landmarks and, if it is accepted, refine it on all terms at once.

    Returns None if too few features match. ``rays`` is the number of rays rendered for the refinement; 0 leaves rendering
    out, also where it would tell which intrinsics are right.
    """
    found = propose(matcher, problem.views, seed=seed)
    if found is not None and rays:
        found = _with_camera_judged(problem, matcher, found, seed)
    return None if found is None else fused_answer(problem, found, landmark_verdict(found), rays, seed)


def _with_camera_judged(
    problem: Problem, matcher: LandmarkMatcher, found: LandmarkPose, seed: int
) -> LandmarkPose:
    """Return a pose again with what renderings say about the camera, where landmarks do not tell which intrinsics are right."""
    if landmark_verdict(found).outcome is not Outcome.MISCALIBRATED:
        return found
    evidence, limits = NO_EVIDENCE, LandmarkThresholds()
    if doubtful_intrinsics(found, limits):
        other, correction = _other_camera(problem, matcher, found), found.miscalibration.alternative
        odds = _log_odds_of(problem, found, correction, lambda _: other, seed)
        evidence = CameraEvidence(map_camera=-odds if found.takes_map_camera else odds)
        found = propose(matcher, problem.views, seed=seed, evidence=evidence) or found
    if not found.estimates_calibration and found.miscalibration.worst[1] > limits.miscalibration:
        correction = found.miscalibration.apparent
        change = Calibration(*correction.tolist())
        evidence = replace(evidence, mistaken=_log_odds_of(problem, found, correction, change.applied, seed))
        found = propose(matcher, problem.views, seed=seed, evidence=evidence) or found
    return found


def _other_camera(problem: Problem, matcher: LandmarkMatcher, found: LandmarkPose) -> Intrinsics:
    """Return those of the given intrinsics and the map's that were not taken."""
    given = problem.views[-1].frame.intrinsics
    camera = None if found.takes_map_camera else map_camera(given, matcher.landmarks.cameras)
    return given if camera is None else camera.intrinsics


def _log_odds_of(
    problem: Problem,
    found: LandmarkPose,
    correction: Float[Tensor, "4"],
    corrected_camera: Callable[[Intrinsics], Intrinsics],
    seed: int,
) -> float:
    """Return the logarithm of the odds, by renderings, that a correction of the intrinsics taken is right and not these.

    ``correction`` tells how far the pose moves with it.
    """
    taken = corrected(problem, found)
    views = tuple(
        replace(view, frame=replace(view.frame, intrinsics=corrected_camera(view.frame.intrinsics)))
        for view in taken.views
    )
    other = replace(taken, views=views, start=found.with_correction(correction))
    return log_odds_by_rendering(other, taken, seed)


def fused_answer(
    problem: Problem, found: LandmarkPose, verdict: Verdict, rays: int, seed: int, searched: bool = True
) -> LandmarkAnswer:
    """Return a pose by landmarks, refined on all terms at once if it is accepted.

    ``searched`` is false if landmarks only confirm a pose that was found by other means.
    """
    diagnostics = landmark_diagnostics(found, searched)
    answer = LandmarkAnswer(found, verdict, found.T_world_camera, found.full_covariance, diagnostics)
    if not verdict.accepted or found.estimates_calibration:
        return _judged(answer)  # the other terms would need intrinsics as exact as the landmarks'
    problem = corrected(problem, found)
    about, generator = pivot("scene", problem), Generator().manual_seed(seed)
    terms = dict[str, FusedTerm]()
    if problem.surface is not None and problem.has_depth:
        terms["depth"], judge = _surface_term(problem, problem.surface, generator)
        diagnostics = landmark_diagnostics(found, searched, judge, found.T_world_camera)
        answer = replace(answer, diagnostics=diagnostics)
    answer = _judged(answer)
    if rays and is_sharp(problem):
        effort = 1 if (answer.confidence or 0.0) >= TRUSTED else THOROUGHLY
        terms["rendering"] = _rendered_term(problem, rays, about, generator, effort)
        return _fused(answer, terms, about, effort * FUSION_STEPS)
    return _fused(answer, terms, about, FUSION_STEPS) if terms else answer


def _judged(answer: LandmarkAnswer) -> LandmarkAnswer:
    """Return the answer with its confidence, which can turn its verdict into a rejection."""
    judgement = judged(answer.verdict, answer.diagnostics)
    return replace(answer, verdict=judgement.verdict, confidence=judgement.confidence)


def corrected(problem: Problem, found: LandmarkPose) -> Problem:
    """Return the problem from the pose found, with its intrinsics and with measured depth on the map's scale."""
    scale, views = shrunk_depth_scale(found, problem.sensor), []
    for view in problem.views:
        depth = None if view.frame.depth is None else view.frame.depth * scale
        camera = found.intrinsics_of(view.frame.intrinsics) or view.frame.intrinsics
        views.append(replace(view, frame=replace(view.frame, depth=depth, intrinsics=camera)))
    return replace(problem, start=found.T_world_camera, views=tuple(views))


def shrunk_depth_scale(found: LandmarkPose, sensor: DepthSensorModel) -> float:
    """Return the factor on measured depth that landmarks give, shrunk towards 1 by the prior; 1 if they give none.

    The prior is that of the sensor's scale, ``PRIOR_WIDTH`` times as wide.
    """
    if found.depth_scale is None:
        return 1.0
    prior = PRIOR_WIDTH * sensor.scale
    weight = prior**2 / (prior**2 + DEPTH_SCALE_NOISE**2)
    return 1 + weight * (found.depth_scale - 1)


def is_sharp(problem: Problem) -> bool:
    """Whether the field is sharp enough for rendered rays to add to what landmarks tell."""
    return problem.colour_noise is None or problem.colour_noise <= SHARPEST


def _surface_term(
    problem: Problem, surface: SurfaceMap, generator: Generator
) -> tuple[FusedTerm, SurfaceCost]:
    """Return the term of measured points on the surface, and the cost itself."""
    cloud = PointCloud.measured(problem.views, problem.depth_rays, POINTS, generator)
    cost = finest_cost(surface, cloud)
    assert problem.start is not None
    return surface_term(cost, problem.start, len(problem.views)), cost


def _rendered_term(problem: Problem, rays: int, about: Pivot, generator: Generator, effort: int) -> FusedTerm:
    """Return the term that compares rendered rays with the images; the loss of colours leaves out what hides the scene."""
    stage = RefinementStage(
        effort * FUSION_STEPS, effort * rays, depth_scale=rendered_depth_scale(problem.bounds)
    )
    depth = DepthSettings() if problem.has_depth else None
    colour = ColourSettings(colour_loss="geman-mcclure")
    settings = RenderedCostSettings(colour, depth, RefinementSettings(exposure=True))
    cost = settings.drawn(problem, stage, about, generator)
    assert problem.start is not None
    term = rendered_term(cost, float(cost.cost(problem.start[None])[0]), len(problem.views))
    return replace(term, measurements=effort**2 * term.measurements)


def _fused(answer: LandmarkAnswer, terms: dict[str, FusedTerm], about: Pivot, steps: int) -> LandmarkAnswer:
    """Minimize the sum of the landmarks' Gaussian prior and the other terms, and return the fused pose.

    The covariance counts each additional term as only ``INDEPENDENT`` measurements, because its errors are correlated over
    large parts of an image.
    """
    prior = GaussianPrior(answer.T, answer.covariance, about)
    cost = Sum((prior, *(term.scaled for term in terms.values())))
    done = descend(cost, answer.T[None], steps, about.moved)
    T = done.T[0].normalized()
    information = prior(T[None]).hessian[0]
    for term in terms.values():
        information = information + term.cost(T[None]).hessian[0] * (INDEPENDENT / term.variance)
    covariance = about.at_camera(T, torch.linalg.inv(information))
    return replace(answer, T=T, covariance=(covariance + covariance.mT) / 2, terms=tuple(terms))


def localization_by_landmarks(problem: Problem, answer: LandmarkAnswer, began: float) -> Localization:
    """Return an answer as a localization of method ``auto``."""
    found = answer.found
    poses = [found.T_world_camera, answer.T]
    if problem.start is not None:
        poses = [problem.start, *poses]
    fused = f", fused with {' and '.join(answer.terms)}" if answer.terms else ""
    there = answer.diagnostics.on_surface
    if there is not None and there < MOSTLY:
        fused += f", although only {there:.0%} of the measured points lie on the surface"
    return Localization(
        T_world_camera=answer.T,
        outcome=answer.verdict.outcome,
        reason=answer.verdict.reason + fused,
        steps=len(poses) - 1,
        seconds=time.perf_counter() - began,
        loss=found.noise,
        method="auto",
        poses=SE3.stack(poses),
        losses=torch.full((len(poses) - 1,), found.noise, dtype=torch.float64),
        covariance=answer.full_covariance,
        focal_factor=found.focal_factor,
        intrinsics=found.intrinsics_of(problem.views[-1].frame.intrinsics),
        confidence=answer.confidence,
        diagnostics=answer.diagnostics,
    )
