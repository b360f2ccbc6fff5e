"""Search by landmarks: find a pose and its covariance from images alone, without a start."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch

from bidnerf_core.errors import InputError
from bidnerf_core.frames.frame import View
from bidnerf_core.geometry.se3 import SE3
from bidnerf_core.localization.search.correspondences import LandmarkMatches, query_images
from bidnerf_core.localization.search.guided_refinement import confirmed, refined_pose, visible_and_matching
from bidnerf_core.localization.search.landmark_evidence import described, log10_agreement
from bidnerf_core.localization.search.landmark_pose import LandmarkPose
from bidnerf_core.localization.search.landmark_query import LandmarkQuery
from bidnerf_core.localization.search.matching import LandmarkMatcher
from bidnerf_core.localization.search.miscalibration import NO_EVIDENCE, CameraEvidence
from bidnerf_core.localization.search.other_camera import with_other_camera
from bidnerf_core.localization.search.ransac import Hypothesis, focal_consensus, sample_consensus
from bidnerf_core.localization.search.resized_image import with_resized_map_camera
from bidnerf_core.localization.search.stopwatch import Stopwatch
from bidnerf_core.localization.search.twins import twin_of
from bidnerf_core.localization.search.unguided import unguided_matches
from bidnerf_core.mapping.geometry.calibration import FIXED, NOMINAL, Calibration, CalibrationPrior
from bidnerf_core.mapping.landmarks.features import Features

STRONGEST = 700
"""Number of keypoints, the strongest of an image, that are matched first; all are matched only if these do not suffice."""
CONVINCING = -20.0
"""Logarithm of the number of false alarms below which the matches of the strongest keypoints suffice."""
APPROXIMATE = 0.05
"""Relative standard deviation of the focal length above which it is sought together with the first pose."""
LEAST_INLIERS = 6
"""Least number of inliers for a pose to be refined at all."""
MANY_VISIBLE, CONTRADICTED = 200, 1.5
"""Least number of visible landmarks that can contradict a pose, and multiple of the matches by chance that must match for them
not to contradict it.
"""


def propose(
    matcher: LandmarkMatcher,
    views: Sequence[View],
    features: Features | None = None,
    seed: int = 0,
    prior: CalibrationPrior | None = None,
    evidence: CameraEvidence = NO_EVIDENCE,
    seek_twin: bool = False,
    moving: bool = True,
) -> LandmarkPose | None:
    """Find the pose of the last of ``views``, whose relative poses are known; None if too few landmarks match.

    ``prior``: how uncertain the given intrinsics are; by default they are fixed, or ``NOMINAL`` for a camera whose focal length
    is approximate. ``features`` finds the keypoints, by default the detector of the map. One correction is estimated for all views; those of different cameras are taken as given. ``evidence``: what
    else is known about the camera. ``seek_twin``: whether to look for another place that the images may show. ``moving``:
    whether to estimate how the camera moved while the rows of its image were exposed, where that is evident.
    Raises ``InputError`` if there is no view.
    """
    if not views:
        raise InputError("nothing to localize: expected at least one view")
    prior = _calibration_prior(views) if prior is None else prior
    clock = Stopwatch()
    query = LandmarkQuery(
        query_images(views, features or matcher.features), matcher.landmarks, prior, evidence, moving
    )
    clock.lap("descriptors")
    matches, first = _first_pose(query, matcher, seed, clock)
    if first is None:
        return None
    answer = refined_pose(query, matches[first.inliers], first)
    clock.lap("refinement")
    found = described(query, matches, answer, clock.seconds)
    clock.lap("assessment")
    found = with_other_camera(query, matches, found, clock)
    found = with_resized_map_camera(query, matches, found, clock)
    return _with_twin(query, matcher, found, clock) if seek_twin else found


@dataclass(frozen=True, eq=False)
class Confirmation:
    """The landmarks' evidence about a pose that was found by other means."""

    pose: LandmarkPose | None  # refined on the landmarks that match near it; None if too few do
    visible: int  # landmarks that should be visible there
    matches: int
    chance: float  # matches expected at a wrong pose

    @property
    def contradicts(self) -> bool:
        """Whether no more landmarks match than by chance, although many should."""
        return self.visible >= MANY_VISIBLE and self.matches < CONTRADICTED * self.chance + LEAST_INLIERS


def confirm(
    matcher: LandmarkMatcher,
    views: Sequence[View],
    T_world_camera: SE3,
    features: Features | None = None,
    seek_twin: bool = False,
) -> Confirmation:
    """Match the landmarks near their projections at a pose of the last of ``views``, and refine it.

    ``seek_twin`` is as in ``propose``.
    """
    clock = Stopwatch()
    query = LandmarkQuery(
        query_images(views, features or matcher.features), matcher.landmarks, _calibration_prior(views)
    )
    clock.lap("descriptors")
    visible, matches, chance = visible_and_matching(query, T_world_camera)
    answer = confirmed(query, T_world_camera)
    clock.lap("refinement")
    if answer is None:
        return Confirmation(None, visible, matches, chance)
    # Matches that were not sought near the pose are the evidence for it, and reveal another camera.
    pose = described(query, unguided_matches(query.images, matcher, STRONGEST), answer, clock.seconds)
    agreeing = int((torch.linalg.vector_norm(pose.residuals, dim=-1) <= query.threshold).sum())
    pose = replace(pose, matches=len(pose.correspondences), agreeing=agreeing)
    clock.lap("assessment")
    pose = _with_twin(query, matcher, pose, clock) if seek_twin else pose
    return Confirmation(pose, visible, matches, chance)


def _with_twin(
    query: LandmarkQuery, matcher: LandmarkMatcher, found: LandmarkPose, clock: Stopwatch
) -> LandmarkPose:
    """Return a pose with its twin, if there is one, sought with the intrinsics that were taken or estimated."""
    cameras = [found.intrinsics_of(image.intrinsics) or image.intrinsics for image in query.images]
    seen = replace(query.seen_by(cameras), prior=FIXED, evidence=NO_EVIDENCE)
    twin = twin_of(seen, matcher, found)
    clock.lap("twin")
    return found.with_twin(twin)


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
    found = sample_consensus(data, matches.view, query.threshold, seed)
    if query.prior.log_focal > APPROXIMATE:
        others = (focal_consensus(data, query.threshold, seed), _map_camera_consensus(query, matches, seed))
        hypotheses = [h for h in (found, *others) if h is not None]
        found = max(hypotheses, key=lambda h: int(h.inliers.sum()), default=None)
    if found is None or int(found.inliers.sum()) < LEAST_INLIERS:
        return None
    return found


def _map_camera_consensus(query: LandmarkQuery, matches: LandmarkMatches, seed: int) -> Hypothesis | None:
    """Return the hypothesis that most matches agree with if the map's camera took the images; None where that is improbable.

    With a known focal length, three correct matches make a hypothesis instead of four, and far more are tried in the same time.
    """
    camera = query.map_camera
    if camera is None or not camera.is_near(query.prior):
        return None
    data = query.seen_by([camera.intrinsics] * len(query.images)).observed(matches)
    found = sample_consensus(data, matches.view, query.threshold, seed)
    focal = Calibration(log_focal=camera.calibration.log_focal)
    return None if found is None else replace(found, calibration=focal)
