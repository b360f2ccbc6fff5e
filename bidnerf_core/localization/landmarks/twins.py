"""Rivals of a pose: other poses that explain an image's keypoints about as well.

A scene may be repetitive, such as two rooms with the same furniture. A planar scene has a second pose, see ``planar_pose``.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from bidnerf_core.geometry.se3 import SE3
from bidnerf_core.localization.beyond_chance import log_odds
from bidnerf_core.localization.landmarks.chance import DECISIVE, log_odds_of_share
from bidnerf_core.localization.landmarks.consensus import sample_consensus
from bidnerf_core.localization.landmarks.correspondences import LandmarkMatches
from bidnerf_core.localization.landmarks.evidence import described
from bidnerf_core.localization.landmarks.matching import LandmarkMatcher
from bidnerf_core.localization.landmarks.planar_pose import second_pose
from bidnerf_core.localization.landmarks.pose import LandmarkPose, Rival
from bidnerf_core.localization.landmarks.query import LandmarkQuery
from bidnerf_core.localization.landmarks.refinement import LEAST_GUIDED_MATCHES, RADII, confirmed
from bidnerf_core.localization.landmarks.unguided import LOOKED_UP
from bidnerf_core.mapping.geometry.calibration import GIVEN
from bidnerf_core.mapping.geometry.observations import ObservedPoints

COMPARED = 100
"""Maximum number of correspondences for which similar landmarks at other places are searched for."""
ALIKE = 0.9
"""Minimum ratio of a correspondence's descriptor distance to that of a similar landmark elsewhere."""
LEAST_ALIKE = 0.3
"""Minimum fraction of the correspondences with such a landmark, and of those that agree on one other pose."""


def twin_of(query: LandmarkQuery, matcher: LandmarkMatcher, found: LandmarkPose) -> Rival | None:
    """Return a rival pose in a repetitive scene, or None; ``query`` has the intrinsics used for the pose.

    The keypoints of its correspondences are matched with landmarks at other places. If the scene is not repetitive, few are as
    similar, and those do not agree on a pose.
    """
    here = found.correspondences
    chosen = here[torch.linspace(0, len(here) - 1, min(COMPARED, len(here))).round().long().unique()]
    others = _elsewhere(query, matcher, chosen, found)
    least = max(LEAST_ALIKE * len(chosen), LEAST_GUIDED_MATCHES)
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
    row, column = (ratio <= ALIKE**-2).nonzero().unbind(-1)
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
