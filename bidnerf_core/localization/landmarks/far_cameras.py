"""Cameras so different from the stated one that matching must be repeated: another focal length, a crop or a resized image.

Matches in one part of the scene, such as a single wall, fit a wrong pose with wrong intrinsics as well as the right ones. The
other matches decide: far more of them become inliers if the camera is estimated too.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool

from bidnerf_core.geometry.se3 import SE3
from bidnerf_core.localization.landmarks.consensus import Candidate, focal_consensus, sample_consensus
from bidnerf_core.localization.landmarks.correspondences import MIN_MATCHES, LandmarkMatches
from bidnerf_core.localization.landmarks.evidence import described
from bidnerf_core.localization.landmarks.map_camera import MapCamera, map_cameras
from bidnerf_core.localization.landmarks.pose import LandmarkPose
from bidnerf_core.localization.landmarks.query import LandmarkQuery
from bidnerf_core.localization.landmarks.refinement import refined_pose
from bidnerf_core.mapping.geometry.calibration import ANY, FIXED, STRETCHED, Calibration
from bidnerf_core.mapping.geometry.observations import ObservedPoints
from bidnerf_core.mapping.geometry.reprojection import SCALE, ReprojectionErrors, State
from bidnerf_core.mapping.geometry.resection import minimized

UNSUSPECTED = 0.8
"""Minimum inlier fraction of the matches at which the stated intrinsics are not suspected."""
SUSPECTED, FAR = 0.5, 0.1
"""Inlier fraction of the matches below which a pose may be far off, and the shift of the principal points that are then tried, as
a fraction of the focal length.
"""
SUPPORT_RATIO, MIN_EXTRA_INLIERS = 1.1, 5
"""Factor, and number of exact matches, by which the support of another camera must exceed that of the one found."""
AS_MANY = 0.9
"""Fraction of another camera's inliers that must remain inliers after its refinement."""
FIT_SCALES = (4.0, 1.0)
"""Residuals at which outliers begin in the successive fits, in units of the inlier threshold."""
FEW_DRAWS = 500
"""Maximum number of minimal samples: enough for an inlier ratio of 40 %."""


def with_far_camera(query: LandmarkQuery, matches: LandmarkMatches, found: LandmarkPose) -> LandmarkPose:
    """Return a pose, estimated again with another camera if that has far more inliers among the ``matches`` by descriptors.

    Images from different cameras keep their stated intrinsics.
    """
    if len({image.intrinsics for image in query.images}) > 1:
        return found
    better = better_camera(query, matches, found)
    if better is not None:
        prior = STRETCHED if better.calibration.is_stretched else ANY
        seen = replace(query, prior=prior)
        again = described(refined_pose(seen, matches, better))
        if again.agreeing >= AS_MANY * int(better.inliers.sum()):
            return again
    if found.agreeing < SUSPECTED * found.matches and not found.takes_map_camera:
        sampled = _with_map_camera(query, matches, found)
        if sampled is not None:
            return sampled
    return found if better is None else replace(found, better_camera=better.calibration)


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
    fits = [_fitted(data, here.state, limit, FIT_SCALES)]
    if fits[0].support < enough:
        fits.extend(_from_sample(data, limit))
    if before < SUSPECTED * len(data) and max(fit.support for fit in fits) < enough:
        starts = [
            _turned(T_world_rig, calibration, u, v) for u, v in itertools.product((-FAR, FAR), repeat=2)
        ]
        rough = max(
            (_fitted(data, start, limit, FIT_SCALES[:1]) for start in starts), key=lambda fit: fit.support
        )
        fits.append(_fitted(data, rough.state, limit, FIT_SCALES[1:]))
    best = max(fits, key=lambda fit: fit.support)
    return best.candidate if best.support >= enough else None


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


def _fitted(data: ObservedPoints, start: State, limit: float, scales: Sequence[float]) -> _Fit:
    """Fit a pose and a camera from a start."""
    prior, state = replace(STRETCHED, radial=0.0), start
    deviations = np.append(prior.deviations.numpy(), np.zeros(6))
    errors = ReprojectionErrors(data, start.pose())
    for scale in scales:
        here, _, _ = minimized(errors, state, deviations, scale * limit / SCALE, known_noise=True)
        state = here.state
    return _Fit.of(data, state, limit)


def _from_sample(data: ObservedPoints, limit: float) -> list[_Fit]:
    """Return the fit from the best minimal sample of the matches, with a free focal length.

    It is empty for several views, since their matches do not come from one pinhole camera.
    """
    parts = (data.translation, data.rotation, data.focal)
    if not all(bool((part == part[0]).all()) for part in parts):
        return []
    sampled = focal_consensus(data, limit, seed=0, most_draws=FEW_DRAWS)
    if sampled is None:
        return []
    return [_fitted(data, State.of(sampled.T_world_rig, sampled.calibration), limit, FIT_SCALES[1:])]


def _turned(T_world_rig: SE3, calibration: Calibration, u: float, v: float) -> State:
    """Return a start with a principal point far from the middle, and the camera rotated to keep the image in place."""
    turn = torch.tensor([0.0, 0.0, 0.0, v, -u, 0.0], dtype=torch.float64)
    return State.of(T_world_rig.retract(turn), replace(calibration, shift_u=u, shift_v=v))


def _with_map_camera(
    query: LandmarkQuery, matches: LandmarkMatches, found: LandmarkPose
) -> LandmarkPose | None:
    """Return the pose by minimal samples with one of the map's cameras; None unless it has far more inliers."""
    enough = SUPPORT_RATIO * found.agreeing + MIN_EXTRA_INLIERS
    sampled: list[tuple[MapCamera, Candidate]] = []
    for camera in map_cameras(query.images[-1].intrinsics, query.landmarks.cameras, crops=True):
        data = query.seen_by([camera.intrinsics] * len(query.images)).observed(matches)
        first = sample_consensus(data, matches.view, query.threshold, seed=0)
        if first is not None:
            sampled.append((camera, first))
    if not sampled:
        return None
    camera, first = max(sampled, key=lambda pair: int(pair[1].inliers.sum()))
    if int(first.inliers.sum()) < max(enough, MIN_MATCHES):
        return None
    seen = replace(query.seen_by([camera.intrinsics] * len(query.images)), prior=FIXED)
    again = described(refined_pose(seen, matches, first))
    if again.agreeing < enough or again.estimates_calibration:
        return None
    return replace(again, intrinsics=camera.intrinsics, calibration=Calibration(*camera.correction.tolist()))
