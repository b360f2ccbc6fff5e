"""Refinement of a pose by guided matching: match near the projections, resect, and repeat until the matches settle."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bidnerf_core.camera.rolling_shutter import STILL, MotionPrior
from bidnerf_core.geometry.se3 import SE3
from bidnerf_core.localization.search.correspondences import LandmarkMatches
from bidnerf_core.localization.search.evident_motion import EvidentMotion, evident_motion, share_moving
from bidnerf_core.localization.search.guided import (
    ProjectedLandmarks,
    guided_matches,
    projected_landmarks,
)
from bidnerf_core.localization.search.landmark_query import LandmarkQuery
from bidnerf_core.localization.search.miscalibration import (
    NO_EVIDENCE,
    Miscalibration,
    TakenIntrinsics,
    probability_of_crop,
    taken_intrinsics,
)
from bidnerf_core.localization.search.ransac import Hypothesis
from bidnerf_core.mapping.geometry.calibration import (
    ANY,
    CALIBRATED,
    CROPPED,
    DOUBTED,
    FIXED,
    GIVEN,
    NOMINAL,
    CalibrationPrior,
)
from bidnerf_core.mapping.geometry.observations import ObservedPoints
from bidnerf_core.mapping.geometry.resection import ReprojectionFit, log_likelihood_ratio, resect
from bidnerf_core.mapping.landmarks.features import NORM

RADII = (3.0, 1.5)
"""Radii of the rounds of guided matching, in units of the inlier threshold."""
GUIDED_ROUNDS = 3
"""Largest number of rounds of guided matching with the last radius; they end once the matches no longer change."""
UNCHANGED = 0.02
"""Share of the matches that may change in the last round."""
LOOSE = 1.3
"""Largest descriptor distance of a guided match, in units of the 90 % quantile over the first inliers."""
DEPTH_OFF = 0.1
"""Largest relative difference between a landmark's depth and the depth that was measured at its keypoint."""
CERTAIN, CERTAIN_WITH_EVIDENCE = 0.999, 0.98
"""Probability that the given intrinsics are wrong above which the estimated ones are taken: by keypoints alone, and where other
measurements provide evidence too.
"""
POSSIBLE_CROP, PROBABLE_CROP = 0.1, 0.5
"""Probabilities that an image is a crop: thresholds for its principal point.

Above the first, the principal point is free in the fit that judges the intrinsics, which are then doubtful; above the second,
it may be estimated. Where the focal length is approximate, and therefore estimated anyway, the first is enough for that.
"""
MOST_DISTANCE = (0.5 * NORM) ** 2
"""Largest squared descriptor distance of a guided match, where no first inliers show what is usual."""
LEAST_GUIDED_MATCHES = 6
"""Least number of guided matches for another round."""


@dataclass(frozen=True, eq=False)
class GuidedPose:
    """A pose refined on guided matches."""

    query: LandmarkQuery  # with the intrinsics taken
    fit: ReprojectionFit
    correspondences: LandmarkMatches
    visible: int  # landmarks that should be visible from there
    chance: float  # matches that the last round would find at a wrong pose
    taken: TakenIntrinsics
    miscalibration: Miscalibration
    motion_doubt: Float[
        Tensor, "6 6"
    ]  # what the doubt about a motion between rows adds to the pose's covariance


def refined_pose(
    query: LandmarkQuery,
    inliers: LandmarkMatches,
    first: Hypothesis,
    prior: CalibrationPrior | None = None,
) -> GuidedPose:
    """Refine the pose on the inliers, then on guided matches within shrinking radii until they no longer change.

    ``prior``: how uncertain the given intrinsics are before they are judged, if more than ``query`` states.
    """
    prior = query.prior if prior is None else prior
    most = usual_distance(query, inliers)
    correlation = query.landmarks.correlation_of(len(inliers))
    fit = resect(
        query.observed(inliers), first.T_world_rig, query.threshold / 2, prior, first.calibration, correlation
    )
    return _settled(query, fit, inliers, most, prior)


def usual_distance(query: LandmarkQuery, inliers: LandmarkMatches) -> float:
    """Return the largest squared descriptor distance of a guided match, from those of the first inliers."""
    return LOOSE**2 * float(query.squared_distances(inliers).quantile(0.9))


def confirmed(query: LandmarkQuery, T_world_rig: SE3) -> GuidedPose | None:
    """Refine a pose that was found by other means on guided matches; None if there are too few."""
    radius = RADII[0] * query.threshold
    found = guided_matches(query.images, query.landmarks, T_world_rig, radius, MOST_DISTANCE)
    if len(found) < LEAST_GUIDED_MATCHES:
        return None
    correlation = query.landmarks.correlation_of(len(found))
    fit = resect(query.observed(found), T_world_rig, radius / 2, query.prior, correlation=correlation)
    return _settled(query, fit, found, MOST_DISTANCE, query.prior)


def _settled(
    query: LandmarkQuery,
    fit: ReprojectionFit,
    found: LandmarkMatches,
    most: float,
    prior: CalibrationPrior,
) -> GuidedPose:
    """Refine a pose on guided matches, with the given intrinsics unless the matches clearly contradict them.

    ``prior`` is the uncertainty of the intrinsics before they are judged.
    """
    fit, found = _guided(query, prior, fit, found, most, RADII)
    open_camera = prior.log_focal > 0
    free, crop = _with_free_camera(query, fit, found, open_camera)
    # Where a motion is probable from the outset, other intrinsics need not be given the benefit of the doubt.
    usual = CALIBRATED if query.landmarks.moving > 0.5 and not open_camera else NOMINAL
    evident = _evident_motion(query, free, found, ANY if crop > POSSIBLE_CROP else usual)
    motion, correlation = evident.prior, query.landmarks.correlation_of(len(found))
    if motion != STILL:
        data = query.observed(found)
        fit = resect(data, fit.T_world_rig, fit.noise, prior, fit.calibration, correlation, motion)
        fit, found = _guided(query, prior, fit, found, most, RADII[1:], motion)
        free, crop = _with_free_camera(query, fit, found, open_camera, motion)
        correlation = query.landmarks.correlation_of(len(found))
    evidence, approximate = query.evidence, query.prior.log_focal > 0
    camera = query.map_camera_near(free.calibration)
    taken = taken_intrinsics(free, query.landmarks, camera, approximate, evidence.map_camera)
    right = query.prior if approximate and taken.camera is None else CALIBRATED
    wrong = Miscalibration.of(free, query.landmarks, taken, evidence.mistaken, right)
    certain = CERTAIN if evidence == NO_EVIDENCE else CERTAIN_WITH_EVIDENCE
    if approximate and crop > POSSIBLE_CROP:
        taken = TakenIntrinsics()
        fit, found = _guided(query, ANY, free, found, most, RADII[1:], motion)
    elif wrong.worst[1] > certain and not POSSIBLE_CROP < crop < PROBABLE_CROP:
        taken = TakenIntrinsics()
        prior = wrong.prior(query.prior if approximate else DOUBTED, crop >= PROBABLE_CROP)
        fit, found = _guided(query, prior, free, found, most, RADII[1:], motion)
    elif taken.camera is not None:
        query = query.seen_by([taken.camera.intrinsics] * len(query.images))
        fit = resect(query.observed(found), free.T_world_rig, free.noise, FIXED, GIVEN, correlation, motion)
        fit, found = _guided(query, FIXED, fit, found, most, RADII[1:], motion)
    elif prior != query.prior:
        prior = query.prior
        fit = resect(query.observed(found), free.T_world_rig, free.noise, prior, GIVEN, correlation, motion)
        fit, found = _guided(query, prior, fit, found, most, RADII[1:], motion)
    radius = RADII[-1] * query.threshold
    projections = projected_landmarks(
        query.images, query.landmarks, fit.T_world_rig, fit.calibration, radius, fit.motion
    )
    visible, chance = sum(map(len, projections)), matches_by_chance(projections, radius, most)
    return GuidedPose(query, fit, found, visible, chance, taken, wrong, evident.doubt)


def _evident_motion(
    query: LandmarkQuery, free: ReprojectionFit, found: LandmarkMatches, camera: CalibrationPrior
) -> EvidentMotion:
    """Return the motion of a single image's camera; a rig, whose views may be from different moments, counts as still."""
    if not query.may_move:
        return EvidentMotion()
    correlation = query.landmarks.correlation_of(len(found))
    return evident_motion(query.observed(found), free, correlation, camera, share_moving(query.landmarks))


def _with_free_camera(
    query: LandmarkQuery,
    fit: ReprojectionFit,
    found: LandmarkMatches,
    open_camera: bool,
    motion: MotionPrior = STILL,
) -> tuple[ReprojectionFit, float]:
    """Return a fit of the intrinsics along with the pose, and the probability that the image is a crop.

    If it may well be one, its principal point is free. ``open_camera``: whether nothing is known about the focal length.
    """
    data, correlation = query.observed(found), query.landmarks.correlation_of(len(found))
    part, whole = (
        resect(data, fit.T_world_rig, fit.noise, prior, fit.calibration, correlation, motion)
        for prior in (ANY if open_camera else CROPPED, NOMINAL)
    )
    ratio = log_likelihood_ratio(data, part, whole, correlation)
    probability = probability_of_crop(part, whole, query.landmarks, ratio, open_camera)
    return (part if probability > POSSIBLE_CROP else whole), probability


def _guided(
    query: LandmarkQuery,
    prior: CalibrationPrior,
    fit: ReprojectionFit,
    found: LandmarkMatches,
    most: float,
    radii: Sequence[float],
    motion: MotionPrior = STILL,
) -> tuple[ReprojectionFit, LandmarkMatches]:
    """Match near the projections and fit the pose to the matches, in rounds."""
    for radius in (*radii[:-1], *[radii[-1]] * GUIDED_ROUNDS):
        guided = guided_matches(
            query.images, query.landmarks, fit.T_world_rig, radius * query.threshold, most, fit.calibration,
            fit.motion,
        )  # fmt: skip
        data = query.observed(guided)
        agrees = _depth_agrees(data, fit.T_world_rig)
        guided, data = guided[agrees], data[agrees]
        if len(guided) < LEAST_GUIDED_MATCHES:
            break
        changed, found = _changed(guided, found), guided
        correlation = query.landmarks.correlation_of(len(found))
        fit = resect(data, fit.T_world_rig, fit.noise, prior, fit.calibration, correlation, motion)
        if changed <= UNCHANGED:
            break
    return fit, found


def _changed(a: LandmarkMatches, b: LandmarkMatches) -> float:
    """Return the share of the matches ``a`` that are not among ``b``."""
    return 1 - float(torch.isin(a.keys, b.keys).float().mean())


def _depth_agrees(data: ObservedPoints, T_world_rig: SE3) -> Bool[Tensor, "m"]:
    """Return which correspondences agree with the depth at the keypoint, up to a common factor, or have no measured depth."""
    z = data.in_camera(T_world_rig)[:, 2]
    known = data.depth > 0
    ratio = torch.where(known, z / torch.where(known, data.depth, 1), 1)
    scale = ratio[known].median() if int(known.sum()) >= LEAST_GUIDED_MATCHES else 1.0
    return (ratio / scale - 1).abs() <= DEPTH_OFF


def visible_and_matching(query: LandmarkQuery, T_world_rig: SE3) -> tuple[int, int, float]:
    """Return how many landmarks should be visible from a pose, how many match near there, and how many would by chance."""
    radius = RADII[0] * query.threshold
    projections = projected_landmarks(query.images, query.landmarks, T_world_rig, GIVEN, radius)
    matches = sum(len(found.matches(radius, MOST_DISTANCE)) for found in projections)
    return sum(map(len, projections)), matches, matches_by_chance(projections, radius, MOST_DISTANCE)


def matches_by_chance(projections: Sequence[ProjectedLandmarks], radius: float, most: float) -> float:
    """Return the number of guided matches expected by chance: the mean over shifts of all keypoints."""
    away = 4 * radius
    shifts = ((away, away), (-away, -away))
    counts = [len(found.matches(radius, most, shift)) for shift in shifts for found in projections]
    return sum(counts) / len(shifts)
