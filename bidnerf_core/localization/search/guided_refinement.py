"""Refinement of a pose by guided matching: match near the projections, resect, and repeat until the matches settle."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bidnerf_core.localization.search.correspondences import LandmarkMatches
from bidnerf_core.localization.search.guided import guided_matches, projected_landmarks
from bidnerf_core.localization.search.landmark_query import LandmarkQuery
from bidnerf_core.localization.search.ransac import Hypothesis
from bidnerf_core.mapping.landmarks import LandmarkMap
from bidnerf_core.mapping.resection import (
    CALIBRATED,
    NOMINAL,
    Calibration,
    CalibrationPrior,
    ObservedPoints,
    ReprojectionFit,
    resect,
)
from bidnerf_core.se3 import SE3

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
MISTAKEN, MISTAKES = CalibrationPrior(log_focal=0.05, shift=0.02, radial=0.05), 0.05
"""Standard deviations of intrinsics that are wrong, and the share of cameras whose intrinsics are."""
CERTAIN = 0.999
"""Probability that the given intrinsics are wrong above which the estimated ones are taken."""
LEAST_MATCHES = 6
"""Least number of guided matches for another round."""


@dataclass(frozen=True, eq=False)
class Miscalibration:
    """How far the intrinsics that fit an image best are from the given ones, and whether these are wrong.

    Images of the map, whose intrinsics are right, seem to need corrections, too; their scatter is part of the noise.
    """

    apparent: Float[Tensor, "4"]  # the correction that fits best, in the order of ``Calibration``
    noise: Float[Tensor, "4"]  # standard deviations of that estimate by the noise of the keypoints
    probability: Float[Tensor, "4"]  # that the given parameter is wrong

    @property
    def deviations(self) -> Float[Tensor, "4"]:
        """The standard deviation of the true correction about zero."""
        return (CALIBRATED.deviations.square() + self.probability * self.apparent.square()).sqrt()


@dataclass(frozen=True, eq=False)
class GuidedPose:
    """A pose refined on guided matches."""

    fit: ReprojectionFit
    prior: CalibrationPrior  # of the intrinsics, as they were taken in the end
    correspondences: LandmarkMatches
    chance: float  # matches that the last round would find at a wrong pose
    miscalibration: Miscalibration


def refined(query: LandmarkQuery, inliers: LandmarkMatches, first: Hypothesis) -> GuidedPose:
    """Refine the pose on the inliers, then on guided matches within shrinking radii until they no longer change.

    The intrinsics are taken as given, unless the matches contradict them; they are estimated then.
    """
    most = LOOSE**2 * float(query.squared_distances(inliers).quantile(0.9))
    start = Calibration(log_focal=math.log(first.focal_factor))
    data, correlation = query.observed(inliers), query.landmarks.correlation
    fit = resect(data, first.T_world_rig, query.threshold / 2, query.prior, start, correlation)
    fit, found = _guided(query, query.prior, fit, inliers, most, RADII)
    free = resect(query.observed(found), fit.T_world_rig, fit.noise, NOMINAL, fit.calibration, correlation)
    prior = query.prior
    wrong = miscalibration(free, query.landmarks)
    if float(wrong.probability.max()) > CERTAIN and not prior.log_focal:
        prior = NOMINAL
        fit, found = _guided(query, prior, free, found, most, RADII[1:])
    return GuidedPose(fit, prior, found, _chance(query, fit, most), wrong)


def _guided(
    query: LandmarkQuery,
    prior: CalibrationPrior,
    fit: ReprojectionFit,
    found: LandmarkMatches,
    most: float,
    radii: Sequence[float],
) -> tuple[ReprojectionFit, LandmarkMatches]:
    """Match near the projections and fit the pose to the matches, in rounds."""
    for radius in (*radii[:-1], *[radii[-1]] * GUIDED_ROUNDS):
        guided = guided_matches(
            query.images, query.landmarks, fit.T_world_rig, radius * query.threshold, most, fit.calibration
        )
        data = query.observed(guided)
        agrees = _depth_agrees(data, fit.T_world_rig)
        guided, data = guided[agrees], data[agrees]
        if len(guided) < LEAST_MATCHES:
            break
        changed, found = _changed(guided, found), guided
        fit = resect(data, fit.T_world_rig, fit.noise, prior, fit.calibration, query.landmarks.correlation)
        if changed <= UNCHANGED:
            break
    return fit, found


def miscalibration(free: ReprojectionFit, landmarks: LandmarkMap) -> Miscalibration:
    """Judge whether the given intrinsics are wrong, by those that were estimated along with the pose."""
    value = torch.tensor(dataclasses.astuple(free.calibration), dtype=torch.float64)
    noise = free.calibration_deviations.square() + landmarks.calibration_scatter.square()
    right, wrong = (noise + prior.deviations.square() for prior in (CALIBRATED, MISTAKEN))
    log_ratio = 0.5 * (value.square() / right - value.square() / wrong + right.log() - wrong.log())
    log_odds = log_ratio + math.log(MISTAKES / (1 - MISTAKES))
    return Miscalibration(value, free.calibration_deviations, log_odds.sigmoid())


def _changed(a: LandmarkMatches, b: LandmarkMatches) -> float:
    """Return the share of the matches ``a`` that are not among ``b``."""
    keypoints = 1 << 32
    keys = [((m.view * keypoints) + m.keypoint) * keypoints + m.landmark for m in (a, b)]
    return 1 - float(torch.isin(*keys).float().mean())


def _depth_agrees(data: ObservedPoints, T_world_rig: SE3) -> Bool[Tensor, "m"]:
    """Return which correspondences have a landmark that fits the depth measured at the keypoint, or no measured depth."""
    z = data.in_camera(T_world_rig)[:, 2]
    known = data.depth > 0
    ratio = torch.where(known, z / torch.where(known, data.depth, 1), 1)
    scale = ratio[known].median() if int(known.sum()) >= LEAST_MATCHES else 1.0
    return (ratio / scale - 1).abs() <= DEPTH_OFF


def _chance(query: LandmarkQuery, fit: ReprojectionFit, most: float) -> float:
    """Return the number of guided matches expected by chance: the mean over shifts of all keypoints."""
    radius = RADII[-1] * query.threshold
    away = 4 * radius
    shifts = ((away, away), (-away, -away))
    projections = projected_landmarks(query.images, query.landmarks, fit.T_world_rig, fit.calibration, radius)
    counts = [len(found.matches(radius, most, shift)) for shift in shifts for found in projections]
    return sum(counts) / len(shifts)
