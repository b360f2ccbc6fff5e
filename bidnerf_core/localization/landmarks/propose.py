"""Localization by landmarks: find a pose and its covariance from images alone, without a start."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch

from bidnerf_core.errors import InputError
from bidnerf_core.frames import View
from bidnerf_core.geometry import SE3
from bidnerf_core.localization.landmarks.chance import CONVINCING
from bidnerf_core.localization.landmarks.consensus import Candidate, focal_consensus, sample_consensus
from bidnerf_core.localization.landmarks.correspondences import MIN_MATCHES, LandmarkMatches, query_images
from bidnerf_core.localization.landmarks.evidence import described, log10_agreement
from bidnerf_core.localization.landmarks.far_cameras import better_camera, with_far_camera
from bidnerf_core.localization.landmarks.guided_pose import (
    agreeing_with,
    confirmed,
    refined_pose,
    visible_and_matching,
)
from bidnerf_core.localization.landmarks.matching import STRONGEST, LandmarkMatcher, unguided_matches
from bidnerf_core.localization.landmarks.pose import LandmarkPose
from bidnerf_core.localization.landmarks.query import LandmarkQuery
from bidnerf_core.localization.landmarks.twins import second_of_plane, twin_of
from bidnerf_core.localization.recording import current_record
from bidnerf_core.mapping import FIXED, NOMINAL, Calibration, CalibrationPrior, Features

MANY_VISIBLE, CONTRADICTED = 200, 1.5
"""Minimum number of visible landmarks for contradicting a pose, and multiple of the chance matches below which they contradict
it.
"""


def propose(
    matcher: LandmarkMatcher,
    views: Sequence[View],
    features: Features | None = None,
    seed: int = 0,
    prior: CalibrationPrior | None = None,
    seek_rivals: bool = False,
    moving: bool = True,
) -> LandmarkPose | None:
    """Find the pose of the last of ``views``, whose relative poses are known; None if too few landmarks match.

    ``prior`` is that of the given intrinsics; by default they are fixed, or ``NOMINAL`` for an approximate focal length.
    ``features`` detects the keypoints, by default the map's detector. One correction of the intrinsics is estimated for all
    views; if these are from different cameras, their intrinsics are fixed. ``seek_rivals`` is whether to search for other
    poses that explain the images, and ``moving`` whether to estimate the camera's motion during readout if it is evident.
    Raises ``InputError`` if there are no views.
    """
    if not views:
        raise InputError("nothing to localize:", expected="at least one view")
    prior = _calibration_prior(views) if prior is None else prior
    query = LandmarkQuery(query_images(views, features or matcher.features), matcher.landmarks, prior, moving)
    matches, first = _first_pose(query, matcher, seed)
    if first is None:
        return None
    answer = refined_pose(query, matches, first)
    found = with_far_camera(query, matches, described(answer))
    return _with_rivals(query, matcher, found) if seek_rivals else found


def updated(found: LandmarkPose, log_odds: Mapping[str, float]) -> LandmarkPose:
    """Update a pose with log odds of intrinsics from further evidence, see ``Posterior.updated``.

    It is refined again if other intrinsics have become the most probable, but without a new search.
    """
    if found.guided is None:
        raise ValueError("tracked landmarks have no posterior to which evidence can be added")
    again = described(found.guided.updated(log_odds))
    return replace(again, better_camera=found.better_camera, rivals=found.rivals)


@dataclass(frozen=True, eq=False)
class Confirmation:
    """The landmarks' evidence about a pose found by other means."""

    pose: LandmarkPose | None  # refined on the landmarks that match near it; None if too few do
    visible: int  # number of landmarks that should be visible there
    matches: int
    chance: float  # matches expected at a wrong pose

    @property
    def contradicts(self) -> bool:
        """Whether hardly more landmarks match than expected by chance, although many should."""
        return self.visible >= MANY_VISIBLE and self.matches < CONTRADICTED * self.chance + MIN_MATCHES


def confirm(
    matcher: LandmarkMatcher,
    views: Sequence[View],
    T_world_camera: SE3,
    features: Features | None = None,
    seek_rivals: bool = False,
    rival: SE3 | None = None,
) -> Confirmation:
    """Match the landmarks near their projections at a pose of the last of ``views``, and refine it.

    ``seek_rivals`` is as in ``propose``. ``rival`` is another pose; matches only with it are no evidence of another camera.
    """
    query = LandmarkQuery(
        query_images(views, features or matcher.features), matcher.landmarks, _calibration_prior(views)
    )
    visible, matches, chance = visible_and_matching(query, T_world_camera)
    # Matches that are independent of the pose are the evidence for it, and reveal another camera.
    by_descriptors = unguided_matches(query.images, matcher, STRONGEST)
    if rival is not None:
        of_rival = agreeing_with(query, by_descriptors, rival)
        by_descriptors = by_descriptors[~of_rival | agreeing_with(query, by_descriptors, T_world_camera)]
    answer = confirmed(query, by_descriptors, T_world_camera)
    if answer is None:
        return Confirmation(None, visible, matches, chance)
    pose = described(answer)
    better = better_camera(query, by_descriptors, pose)
    agreeing = int((torch.linalg.vector_norm(pose.residuals, dim=-1) <= query.threshold).sum())
    pose = replace(
        pose, matches=len(pose.correspondences), agreeing=agreeing,
        better_camera=None if better is None else better.calibration,
    )  # fmt: skip
    pose = _with_rivals(query, matcher, pose) if seek_rivals else pose
    return Confirmation(pose, visible, matches, chance)


def _with_rivals(query: LandmarkQuery, matcher: LandmarkMatcher, found: LandmarkPose) -> LandmarkPose:
    """Search for rivals of a pose, with the intrinsics used for it, and return the pose with them."""
    cameras = [found.intrinsics_of(image.intrinsics) or image.intrinsics for image in query.images]
    seen = replace(query.seen_by(cameras), prior=FIXED)
    rivals = (twin_of(seen, matcher, found), second_of_plane(seen, found))
    return replace(found, rivals=tuple(rival for rival in rivals if rival is not None))


def _calibration_prior(views: Sequence[View]) -> CalibrationPrior:
    one_camera = len({view.frame.intrinsics for view in views}) == 1
    return NOMINAL if one_camera and any(view.frame.focal_is_approximate for view in views) else FIXED


def _first_pose(
    query: LandmarkQuery, matcher: LandmarkMatcher, seed: int
) -> tuple[LandmarkMatches, Candidate | None]:
    """Match the strongest keypoints, and then all if those do not give a convincing pose."""
    most = max(len(image.keypoints) for image in query.images)
    for count in (min(STRONGEST, most), most):
        matches = unguided_matches(query.images, matcher, count)
        found = _consensus(query, matches, seed)
        agreeing = 0 if found is None else int(found.inliers.sum())
        if count == most or log10_agreement(query, matches, agreeing) < CONVINCING:
            break
    return matches, found


def _consensus(query: LandmarkQuery, matches: LandmarkMatches, seed: int) -> Candidate | None:
    data = query.observed(matches)
    found = sample_consensus(data, matches.view, query.threshold, seed)
    if query.prior != FIXED:  # the focal length is estimated along with the initial pose
        free = focal_consensus(data, query.threshold, seed)
        hypotheses = [h for h in (found, free, *_map_camera_consensus(query, matches, seed)) if h is not None]
        found = max(hypotheses, key=lambda h: int(h.inliers.sum()), default=None)
    if found is not None and (record := current_record()) is not None:
        agreeing = f"{int(found.inliers.sum())} of {len(matches)} matches agree"
        record.add(f"sample consensus: {agreeing}", found.T_world_rig)
    if found is None or int(found.inliers.sum()) < MIN_MATCHES:
        return None
    return found


def _map_camera_consensus(query: LandmarkQuery, matches: LandmarkMatches, seed: int) -> list[Candidate]:
    """Return the candidates with the most inliers for each of the map's cameras that may have taken the images.

    With a known focal length, a minimal sample has three matches instead of four, and far more samples fit into the same time.
    """
    found = []
    for hypothesis in query.hypotheses:
        if hypothesis.camera is None:
            continue
        data = query.seen_by([hypothesis.camera] * len(query.images)).observed(matches)
        sampled = sample_consensus(data, matches.view, query.threshold, seed)
        if sampled is not None:
            found.append(replace(sampled, calibration=Calibration(log_focal=float(hypothesis.mean[0]))))
    return found
