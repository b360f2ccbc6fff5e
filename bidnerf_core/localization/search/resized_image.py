"""Whether an image was taken by the map's camera and then resized to another aspect ratio.

A small stretch goes unnoticed otherwise: a motion between the rows, another focal length or, where the landmarks lie on a plane,
a wrong pose make up for it. An image of another camera whose sensor has another aspect ratio is no different at first sight, so
the two hypotheses are compared by their evidence.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch

from bidnerf_core.camera_shapes import stretched_cameras
from bidnerf_core.localization.search.correspondences import LandmarkMatches
from bidnerf_core.localization.search.evident_motion import SHARE_MOVING
from bidnerf_core.localization.search.landmark_pose import LandmarkPose
from bidnerf_core.localization.search.landmark_query import LandmarkQuery
from bidnerf_core.localization.search.map_camera import ALIKE_SHAPES
from bidnerf_core.localization.search.miscalibration import WRONG_SHARE
from bidnerf_core.localization.search.other_camera import AS_MANY, sampled_with_map_camera
from bidnerf_core.localization.search.stopwatch import Stopwatch
from bidnerf_core.mapping.calibration import FIXED
from bidnerf_core.mapping.observed_points import ObservedPoints
from bidnerf_core.mapping.resection import ReprojectionFit, log_likelihood, resect
from bidnerf_core.rolling_shutter import STILL, MotionPrior

RESIZED = 0.05
"""Share of resized images among those whose pixels have another aspect ratio than the map's images at their size would have."""


def with_resized_map_camera(
    query: LandmarkQuery, matches: LandmarkMatches, found: LandmarkPose, clock: Stopwatch
) -> LandmarkPose:
    """Return a pose again with the map's camera if the image is more probably one of it that was resized to another aspect ratio.

    ``matches`` are those by descriptors alone. What is left of doubt is part of the covariance. Images of different cameras are
    taken as they are given.
    """
    if found.takes_map_camera or not _may_be_resized(query):
        return found
    other = sampled_with_map_camera(query, matches, AS_MANY * found.agreeing, clock)
    if other is None:
        return found
    odds = _log_odds(query, other, found)
    chosen, rejected = (other, found) if odds > 0 else (found, other)
    shift = (chosen.T_world_camera.inverse() @ rejected.T_world_camera).log()
    doubt = torch.outer(shift, shift) / (1 + math.exp(min(abs(odds), 100.0)))
    clock.lap("map's camera")
    return replace(chosen, covariance=chosen.covariance + doubt)


def _may_be_resized(query: LandmarkQuery) -> bool:
    """Return whether the aspect ratio of the given pixels differs from those of all the map's images, resized to this size."""
    given, *others = {image.intrinsics for image in query.images}
    if others or not query.landmarks.cameras:
        return False
    groups = stretched_cameras(query.landmarks.cameras, given.width, given.height)
    ratio = given.fx / given.fy
    return all(abs(math.log(c.fx / c.fy / ratio)) > ALIKE_SHAPES for group in groups for c in group)


def _log_odds(query: LandmarkQuery, other: LandmarkPose, found: LandmarkPose) -> float:
    """Return the logarithm of the odds that the image was resized, so that ``other`` is its pose, and not ``found``."""
    shared = _union(found.correspondences, other.correspondences)
    correlation = query.landmarks.correlation_of(len(shared))
    fits = [_Fit.of(query, shared, pose, correlation) for pose in (other, found)]
    noise = min(each.fit.noise for each in fits)
    resized, given = (each.log_evidence(noise, correlation) for each in fits)
    return resized - given + math.log(RESIZED / (1 - RESIZED))


def _union(one: LandmarkMatches, other: LandmarkMatches) -> LandmarkMatches:
    """Return the matches that are in either of two sets, each once."""
    new = ~torch.isin(other.keys, one.keys)
    return LandmarkMatches.cat([one, other[new]])


@dataclass(frozen=True, eq=False)
class _Fit:
    """A pose refined with its intrinsics, and with its motion if it has one, on given matches."""

    data: ObservedPoints
    fit: ReprojectionFit
    log_prior: float  # without that of the camera

    @staticmethod
    def of(query: LandmarkQuery, shared: LandmarkMatches, pose: LandmarkPose, correlation: float) -> _Fit:
        cameras = [pose.intrinsics_of(image.intrinsics) or image.intrinsics for image in query.images]
        data = query.seen_by(cameras).observed(shared)
        motion = MotionPrior.usual(pose.distance) if pose.has_motion else STILL
        fit = resect(data, pose.T_world_camera, pose.noise, FIXED, correlation=correlation, motion=motion)
        prior = SHARE_MOVING if pose.has_motion else 1 - SHARE_MOVING
        occam = fit.log_occam_factor(motion) if pose.has_motion else 0.0
        if pose.estimates_calibration:
            prior *= WRONG_SHARE
        return _Fit(data, fit, math.log(prior) + occam)

    def log_evidence(self, noise: float, correlation: float) -> float:
        """Return the logarithm of the evidence, up to a constant; ``noise`` (pixels) is that of the better fit."""
        return log_likelihood(self.data, self.fit, noise, correlation) + self.log_prior
