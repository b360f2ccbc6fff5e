"""Refinement of a pose by guided matching: match near the projections, resect, and repeat until the matches no longer change."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool
from torch import Tensor

from bidnerf_core.camera import STILL, MotionPrior
from bidnerf_core.geometry import SE3
from bidnerf_core.localization.landmarks.consensus import Candidate
from bidnerf_core.localization.landmarks.correspondences import MIN_MATCHES, LandmarkMatches
from bidnerf_core.localization.landmarks.guided import ProjectedLandmarks, guided_matches, projected_landmarks
from bidnerf_core.localization.landmarks.hypotheses import (
    Explanation,
    Motion,
    Posterior,
    Whose,
    posterior,
    share_moving,
)
from bidnerf_core.localization.landmarks.query import LandmarkQuery
from bidnerf_core.mapping import (
    FIXED,
    GIVEN,
    Calibration,
    CalibrationPrior,
    ObservedPoints,
    ReprojectionFit,
    resect,
)

RADII = (3.0, 1.5)
"""Radii of the rounds of guided matching, in units of the inlier threshold."""
GUIDED_ROUNDS = 3
"""Maximum number of rounds of guided matching with the last radius; they end once the matches no longer change."""
UNCHANGED = 0.02
"""Fraction of the matches that may change in the last round."""
DEPTH_OFF = 0.1
"""Maximum relative difference between a landmark's depth and the depth measured at its keypoint."""

MAX_REFITS = 2
"""Maximum number of repeated refinements because other intrinsics or another motion have become more probable."""


@dataclass(frozen=True, eq=False)
class GuidedPose:
    """A pose refined on guided matches, with the most probable intrinsics and motion."""

    query: LandmarkQuery  # with the stated intrinsics
    matches: LandmarkMatches  # by descriptors alone
    fit: ReprojectionFit
    correspondences: LandmarkMatches
    posterior: Posterior
    best: Explanation  # with the intrinsics and the motion of the fit

    @property
    def seen(self) -> LandmarkQuery:
        """The query with the intrinsics of the fit."""
        return _seen(self.query, self.best)

    def visible_and_by_chance(self) -> tuple[int, float]:
        """Return the number of landmarks that should be visible, and of guided matches expected at a wrong pose."""
        seen, fit, radius = self.seen, self.fit, RADII[-1] * self.query.threshold
        projections = projected_landmarks(
            seen.images, seen.landmarks, fit.T_world_rig, fit.calibration, radius, fit.motion
        )
        return sum(map(len, projections)), matches_by_chance(projections, radius, seen.max_distance)

    def updated(self, log_odds: Mapping[str, float]) -> GuidedPose:
        """Return the pose with the most probable intrinsics given further evidence, see ``Posterior.updated``."""
        return _explained(replace(self, posterior=self.posterior.updated(log_odds)), log_odds)


def refined_pose(query: LandmarkQuery, matches: LandmarkMatches, first: Candidate) -> GuidedPose:
    """Refine the pose on its inliers, then on guided matches within shrinking radii until they no longer change."""
    inliers = matches[first.inliers]
    correlation = query.landmarks.correlation_of(len(inliers))
    noise = query.threshold / 2
    fit = resect(
        query.observed(inliers), first.T_world_rig, noise, query.prior, first.calibration, correlation
    )
    return _refined(query, matches, fit, inliers)


def confirmed(query: LandmarkQuery, matches: LandmarkMatches, T_world_rig: SE3) -> GuidedPose | None:
    """Refine a pose found by other means on guided matches; None if there are too few."""
    radius = RADII[0] * query.threshold
    found = guided_matches(query.images, query.landmarks, T_world_rig, radius, query.max_distance)
    if len(found) < MIN_MATCHES:
        return None
    correlation = query.landmarks.correlation_of(len(found))
    fit = resect(query.observed(found), T_world_rig, radius / 2, query.prior, correlation=correlation)
    return _refined(query, matches, fit, found)


def _refined(
    query: LandmarkQuery, matches: LandmarkMatches, fit: ReprojectionFit, found: LandmarkMatches
) -> GuidedPose:
    """Refine a pose on guided matches, first with the stated intrinsics, then with the most probable ones."""
    fit, found = _guided(query, query.prior, fit, found, RADII)
    judged = _posterior(query, fit, found, fit.calibration)
    return _explained(GuidedPose(query, matches, fit, found, judged, judged.stated), {})


def _explained(pose: GuidedPose, log_odds: Mapping[str, float]) -> GuidedPose:
    """Repeat the refinement with the most probable intrinsics and motion until they no longer change."""
    for _ in range(MAX_REFITS):
        best = pose.posterior.best
        if best.is_as(pose.best):
            break
        prior, seen = best.hypothesis.refitted, _seen(pose.query, best)
        motion = MotionPrior.usual(pose.posterior.distance) if best.motion is Motion.MOVING else STILL
        start = best.calibration if best.hypothesis.whose is Whose.ESTIMATED else GIVEN
        T = pose.posterior.pose(best)
        inliers = pose.matches[agreeing_with(seen, pose.matches, T, start)]
        # More agree with it by descriptors only if the new camera differs much from the previous one.
        if len(inliers) <= len(pose.correspondences):
            inliers = pose.correspondences
        data, correlation = seen.observed(inliers), _correlation(seen, inliers)
        fit = resect(data, T, pose.posterior.noise, prior, start, correlation, motion)
        fit, found = _guided(seen, prior, fit, inliers, RADII[1:], motion)
        judged = _posterior(pose.query, fit, found, best.calibration).updated(log_odds)
        pose = replace(pose, fit=fit, correspondences=found, posterior=judged, best=best)
    # If two intrinsics alternate as the more probable, the last are kept.
    return replace(pose, posterior=pose.posterior.with_best(pose.best, pose.fit.T_world_rig))


def agreeing_with(
    query: LandmarkQuery, matches: LandmarkMatches, T_world_rig: SE3, calibration: Calibration = GIVEN
) -> Bool[Tensor, "m"]:
    """Return a mask of the inliers of a pose and a correction of the intrinsics."""
    off = query.observed(matches).corrected(calibration).residuals(T_world_rig)
    return torch.linalg.vector_norm(off, dim=-1) <= query.threshold


def _posterior(
    query: LandmarkQuery, fit: ReprojectionFit, found: LandmarkMatches, calibration: Calibration
) -> Posterior:
    landmarks = query.landmarks
    return posterior(
        query.observed(found), fit.T_world_rig, fit.noise, query.hypotheses, _correlation(query, found), calibration,
        landmarks.calibration_scatter, share_moving(landmarks) if query.may_move else 0.0,
    )  # fmt: skip


def _seen(query: LandmarkQuery, explanation: Explanation) -> LandmarkQuery:
    """Return the query with the intrinsics of an explanation, or the stated ones if the fit estimates them."""
    if explanation.hypothesis.refitted != FIXED:
        return query
    cameras = [explanation.intrinsics(image.intrinsics) for image in query.images]
    return replace(query.seen_by(cameras), prior=FIXED)


def _correlation(query: LandmarkQuery, found: LandmarkMatches) -> float:
    return query.landmarks.correlation_of(len(found))


def _guided(
    query: LandmarkQuery,
    prior: CalibrationPrior,
    fit: ReprojectionFit,
    found: LandmarkMatches,
    radii: Sequence[float],
    motion: MotionPrior = STILL,
) -> tuple[ReprojectionFit, LandmarkMatches]:
    """Alternate guided matching and fitting of the pose until the matches no longer change."""
    for radius in (*radii[:-1], *[radii[-1]] * GUIDED_ROUNDS):
        guided = guided_matches(
            query.images, query.landmarks, fit.T_world_rig, radius * query.threshold, query.max_distance,
            fit.calibration, fit.motion,
        )  # fmt: skip
        data = query.observed(guided)
        agrees = _depth_agrees(data, fit.T_world_rig)
        guided, data = guided[agrees], data[agrees]
        if len(guided) < MIN_MATCHES:
            break
        changed, found = _changed(guided, found), guided
        correlation = _correlation(query, found)
        fit = resect(data, fit.T_world_rig, fit.noise, prior, fit.calibration, correlation, motion)
        if changed <= UNCHANGED:
            break
    return fit, found


def _changed(a: LandmarkMatches, b: LandmarkMatches) -> float:
    """Return the fraction of the matches ``a`` that are not in ``b``."""
    return 1 - float(torch.isin(a.keys, b.keys).float().mean())


def _depth_agrees(data: ObservedPoints, T_world_rig: SE3) -> Bool[Tensor, "m"]:
    """Return a mask of the correspondences without measured depth or consistent with it, up to a common factor."""
    z = data.in_camera(T_world_rig)[:, 2]
    known = data.depth > 0
    ratio = torch.where(known, z / torch.where(known, data.depth, 1), 1)
    scale = ratio[known].median() if int(known.sum()) >= MIN_MATCHES else 1.0
    return (ratio / scale - 1).abs() <= DEPTH_OFF


def visible_and_matching(query: LandmarkQuery, T_world_rig: SE3) -> tuple[int, int, float]:
    """Return the numbers of landmarks that should be visible from a pose, that match near it, and that would by chance."""
    radius, most = RADII[0] * query.threshold, query.max_distance
    projections = projected_landmarks(query.images, query.landmarks, T_world_rig, GIVEN, radius)
    matches = sum(len(found.matches(radius, most)) for found in projections)
    return sum(map(len, projections)), matches, matches_by_chance(projections, radius, most)


def matches_by_chance(projections: Sequence[ProjectedLandmarks], radius: float, most: float) -> float:
    """Return the number of guided matches expected by chance: the mean over shifts of all keypoints."""
    away = 4 * radius
    shifts = ((away, away), (-away, -away))
    counts = [len(found.matches(radius, most, shift)) for shift in shifts for found in projections]
    return sum(counts) / len(shifts)
