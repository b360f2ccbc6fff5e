"""Poses with another camera than the given one: that of the map's images if it is like it, and else one estimated with the pose."""

from __future__ import annotations

from dataclasses import replace

import torch

from bidnerf_core.camera import Intrinsics
from bidnerf_core.localization.search.camera_fit import CameraFit
from bidnerf_core.localization.search.correspondences import LandmarkMatches
from bidnerf_core.localization.search.guided_refinement import refined_pose
from bidnerf_core.localization.search.landmark_evidence import described
from bidnerf_core.localization.search.landmark_pose import LandmarkPose
from bidnerf_core.localization.search.landmark_query import LandmarkQuery
from bidnerf_core.localization.search.map_camera import OTHER_CAMERA, camera_like
from bidnerf_core.localization.search.ransac import Hypothesis
from bidnerf_core.localization.search.stopwatch import Stopwatch
from bidnerf_core.mapping.calibration import ANY, FIXED

AS_MANY = 0.9
"""Share of the matches that agree with another camera that still have to once its errors are weighed, or it is exactly the map's."""
REFUTED = 0.5
"""Probability that the map's intrinsics are wrong from which on they are not taken."""


def with_other_camera(
    query: LandmarkQuery, matches: LandmarkMatches, found: LandmarkPose, clock: Stopwatch
) -> LandmarkPose:
    """Return a pose again with the camera that far more of the ``matches`` by descriptors agree with, if there is one."""
    better = found.better_camera
    estimated = None if better is None else _estimated(query, matches, better, clock)
    if estimated is None and (query.prior != FIXED or not found.estimates_calibration or _is_compared(query)):
        return found
    found = estimated or found
    return _with_map_camera(query, matches, found, clock) or found


def _is_compared(query: LandmarkQuery) -> bool:
    """Whether the map's camera is so near the given one that these were compared already."""
    camera = query.map_camera
    return camera is not None and camera.is_near(OTHER_CAMERA)


def _estimated(
    query: LandmarkQuery, matches: LandmarkMatches, better: CameraFit, clock: Stopwatch
) -> LandmarkPose | None:
    """Return the pose with a camera that is estimated along; None if matches do not agree with it once their errors are weighed."""
    seen = query.seen_by([better.stretch.applied(image.intrinsics) for image in query.images])
    first = Hypothesis(better.T_world_rig, better.inliers, 0, better.calibration)
    answer = refined_pose(seen, matches[better.inliers], first, ANY)
    found = replace(described(seen, matches, answer, clock.seconds), stretch=better.stretch)
    clock.lap("camera")
    return found if found.agreeing >= AS_MANY * better.agreeing else None


def _with_map_camera(
    query: LandmarkQuery, matches: LandmarkMatches, found: LandmarkPose, clock: Stopwatch
) -> LandmarkPose | None:
    """Return the pose with the map's intrinsics if those found are like them and nothing refutes them."""
    given = {image.intrinsics for image in query.images}
    own: Intrinsics | None = found.intrinsics_of(query.images[-1].intrinsics)
    camera = None if own is None or len(given) > 1 else camera_like(own, query.landmarks.cameras)
    if own is None or camera is None or found.takes_map_camera:
        return None
    count = len(query.images)
    off = query.seen_by([own] * count).observed(matches).residuals(found.T_world_camera)
    first = Hypothesis(found.T_world_camera, torch.linalg.vector_norm(off, dim=-1) <= query.threshold, 0)
    seen = replace(query.seen_by([camera] * count), prior=FIXED)
    answer = refined_pose(seen, matches[first.inliers], first)
    again = described(seen, matches, answer, clock.seconds)
    clock.lap("map's camera")
    if (
        again.agreeing < AS_MANY * found.agreeing
        or again.estimates_calibration
        or again.miscalibration.worst[1] > REFUTED
    ):
        return None
    return replace(again, intrinsics=camera, calibration=found.calibration, stretch=found.stretch)
