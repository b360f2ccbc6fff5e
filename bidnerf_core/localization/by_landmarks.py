"""Poses by landmarks: match the query's features with the map's, then fuse the pose with measured depth and rendered rays."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Generator, Tensor

from bidnerf_core.errors import amount, enumeration
from bidnerf_core.geometry import SE3, USUAL, independent
from bidnerf_core.localization.acceptance import (
    LandmarkDiagnostics,
    LandmarkThresholds,
    landmark_diagnostics,
    landmark_verdict,
)
from bidnerf_core.localization.alternatives import decide, log_odds_by_rendering, pose_at
from bidnerf_core.localization.confidence import judged
from bidnerf_core.localization.costs.surface import PointCloud, SurfaceCost
from bidnerf_core.localization.covariance import finest_cost, position_deviation
from bidnerf_core.localization.depth_scale import DepthScale, ScaledPoints, at_pose
from bidnerf_core.localization.fusion import (
    FusedPose,
    Measurements,
    drawn_rays,
    fused_pose,
    nearby_start,
)
from bidnerf_core.localization.landmarks.chance import log_odds_of
from bidnerf_core.localization.landmarks.hypotheses import Whose
from bidnerf_core.localization.landmarks.matching import LandmarkMatcher
from bidnerf_core.localization.landmarks.pose import LandmarkPose
from bidnerf_core.localization.landmarks.propose import propose, updated
from bidnerf_core.localization.normal_equations import GaussianPrior
from bidnerf_core.localization.problem import Problem
from bidnerf_core.localization.recording import current_record
from bidnerf_core.localization.result import Localization, Outcome, Verdict
from bidnerf_core.localization.solvers.pivots import pivot
from bidnerf_core.mapping import SurfaceMap

POINTS = 2000
"""Maximum number of measured points that are fused."""
STEPS = 8
"""Maximum number of steps on the sum of all terms."""
FEW_STEPS = 2
"""Number of steps from a pose by landmarks to the best pose under other intrinsics."""
BASIN = 1.0
"""Standard deviation of a pose by landmarks, in pixels, beyond which rays may converge to a wrong pose."""
THOROUGHLY = 4
"""Factor on the number of rays for such a pose."""
COMPARED_RAYS = 512
"""Maximum number of rays on which starts are compared."""
STARTS = 64
"""Number of starts, drawn from the landmarks' prior, of which the best is refined."""
CONTRADICTORY = 30.0
"""Squared Mahalanobis distance from the landmarks' pose beyond which fused measurements contradict the landmarks."""
SHARPEST = 0.04
"""Colour noise (root mean square) of a field on its training images above which rendering adds nothing to landmarks."""
MOSTLY_ON_SURFACE = 0.5
"""Minimum fraction of the measured points on the surface for a scene to count as not partly hidden."""


@dataclass(frozen=True, eq=False)
class LandmarkAnswer:
    """A pose by landmarks, its fusion with the other measurements, and whether to accept it."""

    found: LandmarkPose
    verdict: Verdict
    T: SE3
    covariance: Float[Tensor, "6 6"]
    diagnostics: LandmarkDiagnostics
    terms: tuple[str, ...] = ()  # the measurements fused with the landmarks
    left_out: str = ""  # measurements not fused because they contradict the landmarks
    has_rival: bool = False  # whether it is rejected because an alternative explanation may be right

    @property
    def full_covariance(self) -> Float[Tensor, "6 6"]:
        """The covariance, including that due to errors in the intrinsics that the image does not rule out.

        These errors affect landmarks and rendered colours alike, and the scale of measured depth is no better known.
        """
        return self.covariance + self.found.doubt.covariance


def answer_by_landmarks(
    problem: Problem, matcher: LandmarkMatcher, rays: int, seed: int, fused: bool = True
) -> LandmarkAnswer | None:
    """Find the pose by landmarks, compare it with alternative explanations, and, if accepted, refine it on all terms jointly.

    Returns None if too few features match. ``rays`` is the number of rays rendered for the refinement; 0 disables all rendering,
    including that which decides between intrinsics or poses. ``fused`` is whether rays are part of the refinement.
    """
    found = propose(matcher, problem.views, seed=seed, seek_rivals=True)
    if found is None:
        return None
    found = _with_camera_rendered(problem, found, seed) if rays else found
    if (record := current_record()) is not None:
        record.landmarks.append(found)
        record.add(f"refined on {amount(found.inliers, 'landmark')}", found.T_world_camera)
    verdict, fused_rays = landmark_verdict(found), rays if fused else 0
    found = found if verdict.accepted else replace(found, rivals=())
    decision = decide(problem, found.T_world_camera, found, rays, seed)
    if decision.rejection is None or not (verdict.accepted or decision.rejection.outcome is Outcome.MIRRORED):
        return fused_answer(problem, found, verdict, fused_rays, seed)
    there = None if decision.better is None else pose_at(problem, matcher, found, decision.better)
    if there is not None and landmark_verdict(there).accepted:
        return fused_answer(problem, there, landmark_verdict(there), fused_rays, seed)
    answer = fused_answer(problem, found, decision.rejection, 0, seed)
    return replace(answer, verdict=decision.rejection, has_rival=True)  # its fit is no evidence


def _with_camera_rendered(problem: Problem, found: LandmarkPose, seed: int) -> LandmarkPose:
    """Add evidence from renderings to a pose if landmarks do not decide which intrinsics are right."""
    if found.guided is None or found.relative_shift <= LandmarkThresholds().relative_shift:
        return found
    posterior = found.guided.posterior
    other = posterior.riskiest
    if other is None:
        return found
    here = at_pose(problem, found)
    views = tuple(
        replace(view, frame=view.frame.replace(intrinsics=other.intrinsics(given.frame.intrinsics)))
        for view, given in zip(here.views, problem.views, strict=True)
    )
    there = replace(here, views=views, start=found.T_world_camera.retract(posterior.shift(other)))
    odds = log_odds_by_rendering(there, here, seed, steps=FEW_STEPS)
    if other.hypothesis.group == Whose.ESTIMATED:
        odds = max(odds, 0.0)  # an inexact estimate renders badly even if the stated intrinsics are wrong
    return updated(found, {other.hypothesis.group: odds})


def fused_answer(
    problem: Problem, found: LandmarkPose, verdict: Verdict, rays: int, seed: int, searched: bool = True
) -> LandmarkAnswer:
    """Return a pose by landmarks, refined on all terms jointly if it is accepted or merely imprecise.

    An imprecise pose stays rejected, but is a better starting point for a search. ``searched`` is false if landmarks only
    confirm a pose found by other means.
    """
    diagnostics = landmark_diagnostics(found, searched)
    answer = LandmarkAnswer(found, verdict, found.T_world_camera, found.stated_covariance, diagnostics)
    may_be_fused = verdict.accepted or verdict.outcome is Outcome.IMPRECISE
    if not may_be_fused or found.estimates_calibration:
        if problem.has_depth and found.estimates_calibration:
            answer = replace(answer, left_out="depth, which needs known intrinsics")
        # Rendering would need intrinsics as exact as the landmarks' too.
        return replace(answer, verdict=judged(verdict, diagnostics))
    problem = at_pose(problem, found)
    points = None
    if problem.surface is not None and problem.has_depth:
        points = _cost_of_points(problem, problem.surface, Generator().manual_seed(seed))
        diagnostics = landmark_diagnostics(found, searched, points, found.T_world_camera)
        answer = replace(answer, diagnostics=diagnostics)
    answer = replace(answer, verdict=judged(verdict, diagnostics))
    return _fused(problem, answer, points, rays, seed)


def is_sharp(problem: Problem) -> bool:
    """Return whether the field is sharp enough for rendered rays to add to the landmarks' information."""
    return problem.colour_noise is None or problem.colour_noise <= SHARPEST


def _cost_of_points(problem: Problem, surface: SurfaceMap, generator: Generator) -> SurfaceCost:
    """Return the cost on the surface of measured points drawn at random."""
    return finest_cost(surface, PointCloud.measured(problem.views, problem.depth_rays, POINTS, generator))


def _fused(
    problem: Problem, answer: LandmarkAnswer, points: SurfaceCost | None, rays: int, seed: int
) -> LandmarkAnswer:
    """Fuse an answer with measured points and rendered rays.

    With points, rays compare colours alone, since the same depth must not count twice, and its scale is not exact. Errors in the
    poses of the map's images affect its surface and field like its landmarks, and errors in the motion during a rolling
    shutter's readout affect rays and points too, so fusion does not reduce them. If the fused pose differs from the landmarks'
    by more than their errors explain, renderings at both poses decide which is right.
    """
    scale = DepthScale.of(answer.found, problem.sensor)
    if points is not None and scale.objection is not None:
        without = replace(answer, left_out=f"depth: {scale.objection}")
        return _fused(problem.without_depth(), without, None, rays, seed)
    fused_rays = rays if is_sharp(problem) else 0
    names = (*(["depth"] if points is not None else []), *(["rendering"] if fused_rays else []))
    if not names:
        return answer
    vague = fused_rays > 0 and _apparent_deviation(problem, answer) > BASIN
    fused_rays *= THOROUGHLY if vague else 1
    measurements = _measurements(problem, answer, scale, points, fused_rays, seed)
    start = _vague_start(problem, measurements, fused_rays, points is None, seed) if vague else None
    fused = fused_pose(measurements, STEPS, start)
    if not float(measurements.prior(fused.T[None]).cost[0]) <= CONTRADICTORY:
        other = fused_pose(measurements.without_landmarks(fused.T), STEPS, fused) if rays else None
        if other is not None and _is_likelier(problem, other.T, answer, seed):
            return _elsewhere(answer, other, names)
        without = replace(answer, left_out=f"{names[0]}, which contradicts the landmarks")
        rest = rays if points is not None else 0
        return _fused(problem.without_depth(), without, None, rest, seed)
    if (record := current_record()) is not None:
        record.add(f"fused with {enumeration(names)}", fused.T)
    covariance = fused.covariance + answer.found.shared_covariance
    return replace(answer, T=fused.T, covariance=covariance, terms=names)


def _vague_start(
    problem: Problem, measurements: Measurements, rays: int, by_depth: bool, seed: int
) -> FusedPose:
    """Return a start for a vague prior: the best of several poses, refined with a loss with a wider basin of convergence."""
    few, many = (
        drawn_rays(
            problem, count, measurements.prior.pivot, Generator().manual_seed(seed), by_depth, loss="huber"
        )
        for count in (min(rays, COMPARED_RAYS), rays // 2)
    )
    near = nearby_start(measurements, few, STARTS, Generator().manual_seed(seed))
    return fused_pose(replace(measurements, rays=many), STEPS, near)


def _apparent_deviation(problem: Problem, answer: LandmarkAnswer) -> float:
    """Return the approximate standard deviation, in pixels, of the scene's projection at a pose by landmarks."""
    focal = max(view.frame.intrinsics.fx for view in problem.views)
    return focal * position_deviation(answer.covariance) / answer.found.distance


def _measurements(
    problem: Problem, answer: LandmarkAnswer, scale: DepthScale, points: SurfaceCost | None, rays: int, seed: int
) -> Measurements:  # fmt: skip
    about, views = pivot("scene", problem) if points is None else points.cloud.pivot, len(problem.views)
    generator, most = Generator().manual_seed(seed), USUAL
    return Measurements(
        prior=GaussianPrior(answer.T, answer.covariance - answer.found.shared_covariance, about),
        points=None if points is None else ScaledPoints(points, scale, answer.found.T_world_camera),
        rays=drawn_rays(problem, rays, about, generator, points is None) if rays else None,
        independent_points=views * most.points,
        independent_rays=independent(rays, views * most.rays),
    )


def _is_likelier(problem: Problem, T: SE3, answer: LandmarkAnswer, seed: int) -> bool:
    """Return whether a pose is more likely than that by landmarks, given renderings and the confidence in the landmarks."""
    sure = min(max(answer.verdict.confidence or 0.5, 1e-12), 1 - 1e-12)
    odds = log_odds_by_rendering(replace(problem, start=T), replace(problem, start=answer.T), seed, steps=0)
    return odds > log_odds_of(sure)


def _elsewhere(answer: LandmarkAnswer, other: FusedPose, names: tuple[str, ...]) -> LandmarkAnswer:
    """Return the answer at the pose of the other measurements, which contradict the landmarks."""
    verdict = Verdict(Outcome.UNCERTAIN, f"{enumeration(names)} contradict the landmarks")
    covariance = other.covariance + answer.found.shared_covariance
    return replace(answer, T=other.T, covariance=covariance, verdict=verdict, terms=names)


def localization_by_landmarks(problem: Problem, answer: LandmarkAnswer, began: float) -> Localization:
    """Convert an answer to a localization of method ``auto``."""
    found = answer.found
    poses = [found.T_world_camera, answer.T]
    if problem.start is not None:
        poses = [problem.start, *poses]
    fused = f", fused with {enumeration(answer.terms)}" if answer.terms else ""
    there = answer.diagnostics.on_surface
    if answer.left_out:
        fused += f", without {answer.left_out}"
    elif there is not None and there < MOSTLY_ON_SURFACE:
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
        confidence=answer.verdict.confidence,
        diagnostics=answer.diagnostics,
    )
