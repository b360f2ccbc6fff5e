"""Rivals of a pose: other poses that explain an image's keypoints about as well.

A scene may be repetitive, such as two rooms with the same furniture. A planar scene has a second pose: from a distance, a plane
tilted to one side of the line of sight looks almost like one tilted to the other side. Both poses are local minima of the
reprojection error, so refinement stays at the one where it started (Schweighofer and Pinz 2006, "Robust pose estimation from a
planar target").
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from bidnerf_core.geometry import SE3
from bidnerf_core.localization.landmarks.chance import DECISIVE, log_odds_of_share
from bidnerf_core.localization.landmarks.consensus import sample_consensus
from bidnerf_core.localization.landmarks.correspondences import MAX_AMBIGUITY, MIN_MATCHES, LandmarkMatches
from bidnerf_core.localization.landmarks.evidence import described
from bidnerf_core.localization.landmarks.guided_pose import RADII, confirmed
from bidnerf_core.localization.landmarks.matching import LOOKED_UP, LandmarkMatcher
from bidnerf_core.localization.landmarks.pose import LandmarkPose, Rival
from bidnerf_core.localization.landmarks.query import LandmarkQuery
from bidnerf_core.localization.support import log_odds
from bidnerf_core.mapping import (
    FIXED,
    GIVEN,
    CalibrationPrior,
    ObservedPoints,
    ReprojectionFit,
    log_likelihood_ratio,
    resect,
)

COMPARED = 100
"""Maximum number of correspondences for which similar landmarks at other places are searched for."""
LEAST_ALIKE = 0.3
"""Minimum fraction of the correspondences that are ambiguous with a landmark elsewhere, and of those that agree on one other pose."""


def twin_of(query: LandmarkQuery, matcher: LandmarkMatcher, found: LandmarkPose) -> Rival | None:
    """Return a rival pose in a repetitive scene, or None; ``query`` has the intrinsics used for the pose.

    The keypoints of its correspondences are matched with landmarks at other places. If the scene is not repetitive, few are as
    similar, and those do not agree on a pose.
    """
    here = found.correspondences
    chosen = here[torch.linspace(0, len(here) - 1, min(COMPARED, len(here))).round().long().unique()]
    others = _elsewhere(query, matcher, chosen, found)
    least = max(LEAST_ALIKE * len(chosen), MIN_MATCHES)
    if _keypoints(others) < least:
        return None
    first = sample_consensus(query.observed(others), others.view, query.threshold, seed=0)
    if first is None or _keypoints(others[first.inliers]) < least:
        return None
    there = confirmed(query, others, first.T_world_rig)
    if there is None or _is_shared(there.correspondences, here):
        return None
    share = (len(there.correspondences) - there.visible_and_by_chance()[1]) / max(len(here) - found.chance, 1)
    odds = log_odds_of_share(share)
    return (
        Rival(there.fit.T_world_rig, odds, _two_places(found, described(there))) if odds < DECISIVE else None
    )


def _two_places(here: LandmarkPose, there: LandmarkPose) -> str:
    if here.inliers == there.inliers:
        return f"the photo fits two places equally well ({here.inliers} landmarks at each)"
    return f"the photo fits two places ({here.inliers} landmarks at one, {there.inliers} at the other)"


def second_of_plane(query: LandmarkQuery, found: LandmarkPose) -> Rival | None:
    """Return the second pose for nearly coplanar correspondences, or None if it fits clearly worse.

    ``query`` is as for ``twin_of``.
    """
    if found.guided is None:
        return None
    data = query.observed(found.correspondences).without_motion(found.T_world_camera, found.motion)
    here = replace(found.guided.fit, calibration=GIVEN, motion=torch.zeros_like(found.motion))
    other = second_pose(data, here, query.landmarks.correlation_of(len(data)))
    if other is None:
        return None
    T = other.fit.T_world_rig
    there, before = (_off_in_depth(data, each) for each in (T, found.T_world_camera))
    odds = other.log_odds + (float(log_odds(there[None], before)[0]) if len(before) > 1 else 0.0)
    why = "the landmarks lie nearly in a plane, which looks alike from two poses"
    return Rival(T, odds, why) if odds < DECISIVE else None


def _off_in_depth(data: ObservedPoints, T_world_rig: SE3) -> Float[Tensor, "k"]:
    """Return the relative differences of measured depths from those at a pose, up to a common factor."""
    known = data.depth > 0
    ratio = (data.in_camera(T_world_rig)[known, 2] / data.depth[known]).abs()
    return (ratio / ratio.median() - 1).abs() if len(ratio) else ratio


def _elsewhere(
    query: LandmarkQuery, matcher: LandmarkMatcher, chosen: LandmarkMatches, found: LandmarkPose
) -> LandmarkMatches:
    """Return matches of the keypoints of ``chosen`` with landmarks that do not project near them, the most similar first."""
    distances, index = matcher.nearest(query.descriptors(chosen), LOOKED_UP)
    ratio = distances / query.squared_distances(chosen).clamp(min=1)[:, None]
    row, column = (ratio <= MAX_AMBIGUITY**-2).nonzero().unbind(-1)
    order = ratio[row, column].argsort(stable=True)
    row, column = row[order], column[order]
    others = LandmarkMatches(chosen.view[row], chosen.keypoint[row], index[row, column], torch.ones(len(row)))
    data = query.observed(others).without_motion(found.T_world_camera, found.motion)
    off = torch.linalg.vector_norm(data.residuals(found.T_world_camera), dim=-1)
    return others[~(off <= RADII[0] * query.threshold)]


def _keypoints(matches: LandmarkMatches) -> int:
    """Return the number of matched keypoints."""
    keys: Int[Tensor, "m"] = (matches.view << 34) + matches.keypoint
    return len(keys.unique())


def _is_shared(there: LandmarkMatches, here: LandmarkMatches) -> bool:
    """Return whether most of the matches at another pose are those of this one, so that both are the same."""
    return float(torch.isin(there.keys, here.keys).float().mean()) > 0.5


FAR_OFF = 10.0
"""Median residual, in standard deviations, beyond which a second pose is discarded before refinement."""
SAME = 5.0
"""Squared Mahalanobis distance, in the first pose's covariance, below which two poses are the same minimum."""


@dataclass(frozen=True, eq=False)
class PlanarPose:
    """The other local minimum of the reprojection error."""

    fit: ReprojectionFit
    log_odds: float  # of the first pose against this one, given the observations


def second_pose(
    data: ObservedPoints,
    first: ReprojectionFit,
    correlation: float = 1.0,
    prior: CalibrationPrior = FIXED,
) -> PlanarPose | None:
    """Return the other local minimum for observations of a plane, or None if refinement leads back to the first.

    The points must be nearly coplanar and subtend a small angle. ``correlation`` is the number of observations that count as one.
    """
    start = start_of_second_pose(data, first.T_world_rig, first.noise)
    if start is None:
        return None
    fit = resect(data, start, first.noise, prior, first.calibration, correlation)
    shift = (first.T_world_rig.inverse() @ fit.T_world_rig).log()
    if float(shift @ torch.linalg.solve(first.covariance, shift)) < SAME:
        return None
    return PlanarPose(fit, log_likelihood_ratio(data, first, fit, correlation))


def start_of_second_pose(data: ObservedPoints, T_world_rig: SE3, noise: float) -> SE3 | None:
    """Return the start of the search for the other minimum, or None if the points are too far from coplanar or too close.

    ``noise`` is that of the keypoints, pixels.
    """
    if len(data) < MIN_MATCHES:
        return None
    start = tilted_to_the_other_side(data.points, T_world_rig)
    off = torch.linalg.vector_norm(data.normalized_residuals(start, noise), dim=-1)
    return start if float(off.median()) <= FAR_OFF else None


def tilted_to_the_other_side(points: Float[Tensor, "m 3"], T_world_camera: SE3) -> SE3:
    """Return the pose from which, to first order, the plane of the points (metres, world) looks the same.

    In the camera's frame, the points are reflected in the plane through their middle perpendicular to the line of sight. For
    coplanar points, which are their own mirror image in their plane, this is a rigid motion.
    """
    middle = points.mean(0)
    normal = torch.linalg.svd(points - middle, full_matrices=False).Vh[-1]
    T_camera_world = T_world_camera.inverse()
    seen = T_camera_world.apply(middle)
    rotation = _mirror(seen) @ T_camera_world.rotation @ _mirror(normal)
    return SE3(rotation, seen - rotation @ middle).inverse()


def _mirror(normal: Float[Tensor, "3"]) -> Float[Tensor, "3 3"]:
    """Return the reflection in the plane through the origin with a normal of any length."""
    unit = torch.nn.functional.normalize(normal, dim=0)
    return torch.eye(3, dtype=normal.dtype) - 2 * torch.outer(unit, unit)
