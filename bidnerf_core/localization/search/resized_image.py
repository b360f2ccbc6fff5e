"""Whether an image was taken by the map's camera and then resized to another aspect ratio.

A small stretch goes unnoticed otherwise: a motion between the rows, another focal length or, where the landmarks lie on a plane,
a wrong pose make up for it. An image of another camera whose sensor has another aspect ratio is no different at first sight, so
the two hypotheses are compared by their evidence.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch

from bidnerf_core.camera.intrinsics import stretched_cameras
from bidnerf_core.camera.rolling_shutter import STILL, MotionPrior
from bidnerf_core.localization.search.correspondences import LandmarkMatches
from bidnerf_core.localization.search.evident_motion import SHARE_MOVING
from bidnerf_core.localization.search.landmark_pose import LandmarkPose
from bidnerf_core.localization.search.landmark_query import LandmarkQuery
from bidnerf_core.localization.search.map_camera import ALIKE_SHAPES
from bidnerf_core.localization.search.miscalibration import WRONG_SHARE
from bidnerf_core.localization.search.other_camera import AS_MANY, sampled_with_map_camera
from bidnerf_core.localization.search.stopwatch import Stopwatch
from bidnerf_core.mapping.geometry.calibration import FIXED
from bidnerf_core.mapping.geometry.observations import ObservedPoints
from bidnerf_core.mapping.geometry.resection import ReprojectionFit, log_likelihood, resect

CONSENSUS = 0.6
"""Share of the matches required in the end that have to agree with minimal samples: these are inexact, and know no motion."""
RESIZED = 0.05
"""Share of resized images among those whose pixels have another aspect ratio than the map's images at their size would have."""


def with_resized_map_camera(
    query: LandmarkQuery, matches: LandmarkMatches, found: LandmarkPose, clock: Stopwatch
) -> LandmarkPose:
    """Return a pose again with the map's camera if the image is more probably one of it that was resized to another aspect ratio.

    ``matches`` are those by descriptors alone. What is left of doubt is part of the covariance. Images of different cameras are
    taken as they are given.
    """
    if not _may_be_resized(query, found):
        return found
    enough = AS_MANY * found.agreeing
    other = sampled_with_map_camera(query, matches, CONSENSUS * enough, enough, clock)
    odds = -math.inf if other is None else log_odds(query, other, found)
    clock.lap("map's camera")
    if other is None or not math.isfinite(odds):
        return found
    chosen, rejected = (other, found) if odds > 0 else (found, other)
    shift = (chosen.T_world_camera.inverse() @ rejected.T_world_camera).log()
    doubt = torch.outer(shift, shift) / (1 + math.exp(min(abs(odds), 100.0)))
    return replace(chosen, covariance=chosen.covariance + doubt)


def _may_be_resized(query: LandmarkQuery, found: LandmarkPose) -> bool:
    """Return whether the pixels of the camera that was found have another aspect ratio than those of all the map's images would have,
    resized to this size.
    """
    given, *others = {image.intrinsics for image in query.images}
    if others or not query.landmarks.cameras:
        return False
    groups = stretched_cameras(query.landmarks.cameras, given.width, given.height)
    own = found.intrinsics_of(given) or given
    ratio = own.fx / own.fy
    return all(abs(math.log(c.fx / c.fy / ratio)) > ALIKE_SHAPES for group in groups for c in group)


def log_odds(query: LandmarkQuery, other: LandmarkPose, found: LandmarkPose) -> float:
    """Return the log odds that the image was resized, so that ``other`` is its pose, against ``found``.

    Each camera may have been at rest or, if the query allows for it, have moved while the rows were exposed: the evidence for it is
    the sum of both, whatever was evident when its pose was found.
    """
    shared = _union(found.correspondences, other.correspondences)
    correlation = query.landmarks.correlation_of(len(shared))
    resized, given = (_fits(query, shared, pose, correlation) for pose in (other, found))
    noise = min(each.fit.noise for each in (*resized, *given))
    evidence = [
        float(torch.tensor([each.log_evidence(noise, correlation) for each in fits]).logsumexp(0))
        for fits in (resized, given)
    ]
    return evidence[0] - evidence[1] + math.log(RESIZED / (1 - RESIZED))


def _union(one: LandmarkMatches, other: LandmarkMatches) -> LandmarkMatches:
    """Return the matches that are in either of two sets, each once."""
    new = ~torch.isin(other.keys, one.keys)
    return LandmarkMatches.cat([one, other[new]])


@dataclass(frozen=True, eq=False)
class _Fit:
    """A pose refined on given matches, with its intrinsics fixed."""

    data: ObservedPoints
    fit: ReprojectionFit
    log_prior: float  # of the motion and of the need to estimate intrinsics

    def log_evidence(self, noise: float, correlation: float) -> float:
        """Return the logarithm of the evidence, up to a constant; ``noise`` (pixels) is that of the best fit."""
        return log_likelihood(self.data, self.fit, noise, correlation) + self.log_prior


def _fits(
    query: LandmarkQuery, shared: LandmarkMatches, pose: LandmarkPose, correlation: float
) -> list[_Fit]:
    """Return the fits of a pose at rest and, if the query allows for it, with a motion."""
    cameras = [pose.intrinsics_of(image.intrinsics) or image.intrinsics for image in query.images]
    data = query.seen_by(cameras).observed(shared)
    unexpected = pose.estimates_calibration and query.prior == FIXED
    camera = math.log(WRONG_SHARE) if unexpected else 0.0
    fits = []
    for motion in (STILL, MotionPrior.usual(pose.distance)) if query.may_move else (STILL,):
        fit = resect(data, pose.T_world_camera, pose.noise, FIXED, correlation=correlation, motion=motion)
        moved = motion != STILL
        prior = math.log(SHARE_MOVING) + fit.log_occam_factor(motion) if moved else math.log(1 - SHARE_MOVING)
        fits.append(_Fit(data, fit, camera + prior))
    return fits
