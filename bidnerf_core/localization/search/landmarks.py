"""Search by landmarks: find a pose and its covariance from images alone, without a start."""

from __future__ import annotations

from collections.abc import Sequence

from bidnerf_core.errors import InputError
from bidnerf_core.frames import View
from bidnerf_core.localization.search.correspondences import LandmarkMatches, query_images
from bidnerf_core.localization.search.guided_refinement import refined
from bidnerf_core.localization.search.landmark_evidence import described, log10_agreement
from bidnerf_core.localization.search.landmark_pose import LandmarkPose
from bidnerf_core.localization.search.landmark_query import LandmarkQuery
from bidnerf_core.localization.search.matching import LandmarkMatcher
from bidnerf_core.localization.search.ransac import Hypothesis, focal_consensus, sample_consensus
from bidnerf_core.localization.search.stopwatch import Stopwatch
from bidnerf_core.localization.search.unguided import unguided_matches
from bidnerf_core.mapping.features import SIFT, Features
from bidnerf_core.mapping.resection import FIXED, NOMINAL, CalibrationPrior

STRONGEST = 700
"""Number of keypoints, the strongest of an image, that are matched first; all are matched only if these do not suffice."""
CONVINCING = -20.0
"""Logarithm of the number of false alarms below which the matches of the strongest keypoints suffice."""
APPROXIMATE = 0.05
"""Relative standard deviation of the focal length above which it is sought together with the first pose."""
LEAST_INLIERS = 6
"""Least number of inliers for a pose to be refined at all."""


def propose(
    matcher: LandmarkMatcher,
    views: Sequence[View],
    features: Features = SIFT,
    seed: int = 0,
    prior: CalibrationPrior | None = None,
) -> LandmarkPose | None:
    """Find the pose of the last of ``views``, whose relative poses are known; None if too few landmarks match.

    ``prior`` says how uncertain the given intrinsics are; by default they are fixed, or ``NOMINAL`` for a camera whose focal
    length is approximate. One correction is estimated for all views; those of different cameras are taken as given. Raises
    ``InputError`` if there is no view.
    """
    if not views:
        raise InputError("nothing to localize: expected at least one view")
    prior = _calibration_prior(views) if prior is None else prior
    clock = Stopwatch()
    query = LandmarkQuery(query_images(views, features), matcher.landmarks, prior)
    clock.lap("descriptors")
    matches, first = _first_pose(query, matcher, seed, clock)
    if first is None:
        return None
    answer = refined(query, matches[first.inliers], first)
    clock.lap("refinement")
    found = described(query, matches, answer, clock.seconds)
    clock.lap("assessment")
    return found


def _calibration_prior(views: Sequence[View]) -> CalibrationPrior:
    one_camera = len({view.frame.intrinsics for view in views}) == 1
    return NOMINAL if one_camera and any(view.frame.focal_is_approximate for view in views) else FIXED


def _first_pose(
    query: LandmarkQuery, matcher: LandmarkMatcher, seed: int, clock: Stopwatch
) -> tuple[LandmarkMatches, Hypothesis | None]:
    """Match the strongest keypoints, then all if those do not give a convincing pose."""
    most = max(len(image.keypoints) for image in query.images)
    for count in (min(STRONGEST, most), most):
        matches = unguided_matches(query.images, matcher, count)
        clock.lap("matching")
        found = _consensus(query, matches, seed)
        clock.lap("ransac")
        agreeing = 0 if found is None else int(found.inliers.sum())
        if count == most or log10_agreement(query, matches, agreeing) < CONVINCING:
            break
    return matches, found


def _consensus(query: LandmarkQuery, matches: LandmarkMatches, seed: int) -> Hypothesis | None:
    data = query.observed(matches)
    if query.prior.log_focal > APPROXIMATE:
        found = focal_consensus(data, query.threshold, seed)
    else:
        found = sample_consensus(data, matches.view, query.threshold, seed)
    if found is None or int(found.inliers.sum()) < LEAST_INLIERS:
        return None
    return found
