"""Cameras so different from the stated one that matching must be repeated: another focal length, a crop or a resized image.

Matches in one part of the scene, such as a single wall, fit a wrong pose with wrong intrinsics as well as the right ones. The
other matches decide: far more of them become inliers if the camera is estimated too.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool

from bidnerf_core.geometry import SE3
from bidnerf_core.localization.landmarks.consensus import Candidate
from bidnerf_core.localization.landmarks.correspondences import LandmarkMatches
from bidnerf_core.localization.landmarks.evidence import described
from bidnerf_core.localization.landmarks.guided_pose import refined_pose
from bidnerf_core.localization.landmarks.pose import LandmarkPose
from bidnerf_core.localization.landmarks.query import LandmarkQuery
from bidnerf_core.mapping import (
    ANY,
    SCALE,
    STRETCHED,
    Calibration,
    ObservedPoints,
    ReprojectionErrors,
    State,
    minimized,
)

UNSUSPECTED = 0.8
"""Minimum inlier fraction of the matches at which the stated intrinsics are not suspected."""
SUPPORT_RATIO, MIN_EXTRA_INLIERS = 1.1, 5
"""Factor, and number of exact matches, by which the support of another camera must exceed that of the one found."""
FIT_SCALES = (4.0, 1.0)
"""Residuals at which outliers begin in the successive fits, in units of the inlier threshold."""


def with_far_camera(query: LandmarkQuery, matches: LandmarkMatches, found: LandmarkPose) -> LandmarkPose:
    """Return a pose, estimated again with another camera if that has far more inliers among the ``matches`` by descriptors.

    Images from different cameras keep their stated intrinsics.
    """
    if len({image.intrinsics for image in query.images}) > 1:
        return found
    better = better_camera(query, matches, found)
    if better is None:
        return found
    prior = STRETCHED if better.calibration.is_stretched else ANY
    again = described(refined_pose(replace(query, prior=prior), matches, better))
    if again.agreeing > found.agreeing:
        return again
    return replace(found, better_camera=better.calibration)


def better_camera(query: LandmarkQuery, matches: LandmarkMatches, found: LandmarkPose) -> Candidate | None:
    """Return a pose and a correction of the intrinsics with far more inliers than the pose ``found``, or None.

    There is no search if most matches are already inliers, or, if the intrinsics of ``found`` were estimated, all of them.
    """
    data = query.observed(matches).without_motion(found.T_world_camera, found.motion)
    return camera_fit(
        data,
        found.T_world_camera,
        found.calibration,
        query.threshold,
        1.0 if found.estimates_calibration else UNSUSPECTED,
    )


def camera_fit(
    data: ObservedPoints,
    T_world_rig: SE3,
    calibration: Calibration,
    limit: float,
    unsuspected: float = UNSUSPECTED,
) -> Candidate | None:
    """Return the fit of a camera with far more inliers than the one that was found; None if there is none.

    ``data`` are matches by descriptors alone; inliers have residuals within ``limit`` (pixels). The camera that was found is the
    stated one corrected by ``calibration``; if its inlier fraction is at least ``unsuspected``, there is no search for another.
    """
    here = _Fit.of(data, State.of(T_world_rig, calibration), limit)
    enough = SUPPORT_RATIO * here.support + MIN_EXTRA_INLIERS
    before = int(here.inliers.sum())
    if not 0 < before < unsuspected * len(data):
        return None
    fit = _fitted(data, here.state, limit)
    return fit.candidate if fit.support >= enough else None


@dataclass(frozen=True, eq=False)
class _Fit:
    """The inliers and support of a pose and a camera."""

    state: State
    inliers: Bool[np.ndarray, "m"]
    support: float  # number of inliers, each weighted by its residual (MSAC: Torr and Zisserman 2000)

    @staticmethod
    def of(data: ObservedPoints, state: State, limit: float) -> _Fit:
        here = ReprojectionErrors(data, state.pose()).linearized(state, np.arange(0))
        off = np.where(here.front, np.linalg.norm(here.off, axis=1), np.inf) / limit
        return _Fit(state, off <= 1, float((1 - off**2).clip(min=0).sum()))

    @property
    def candidate(self) -> Candidate:
        return Candidate(self.state.pose(), torch.from_numpy(self.inliers), 0, self.state.calibration)


def _fitted(data: ObservedPoints, start: State, limit: float) -> _Fit:
    """Fit a pose and a camera from a start."""
    prior, state = replace(STRETCHED, radial=0.0), start
    deviations = np.append(prior.deviations.numpy(), np.zeros(6))
    errors = ReprojectionErrors(data, start.pose())
    for scale in FIT_SCALES:
        here, _, _ = minimized(errors, state, deviations, scale * limit / SCALE, known_noise=True)
        state = here.state
    return _Fit.of(data, state, limit)
