"""Poses with a camera other than the given one: the map's if it is similar, else one that is estimated with the pose."""

from __future__ import annotations

import math
from dataclasses import replace

import torch

from bidnerf_core.camera.intrinsics import Intrinsics, median_camera, stretched_cameras
from bidnerf_core.localization.search.camera_fit import (
    LEAST_EXTRA_INLIERS,
    SUPPORT_RATIO,
    SUSPECTED,
    CameraFit,
    least_change,
    split_stretch,
)
from bidnerf_core.localization.search.correspondences import LandmarkMatches
from bidnerf_core.localization.search.guided_refinement import LEAST_GUIDED_MATCHES, refined_pose
from bidnerf_core.localization.search.landmark_evidence import described
from bidnerf_core.localization.search.landmark_pose import LandmarkPose
from bidnerf_core.localization.search.landmark_query import LandmarkQuery
from bidnerf_core.localization.search.map_camera import (
    OTHER_CAMERA,
    camera_like,
    correction_between,
)
from bidnerf_core.localization.search.ransac import Hypothesis, sample_consensus
from bidnerf_core.localization.search.stopwatch import Stopwatch
from bidnerf_core.mapping.geometry.calibration import ANY, FIXED, Calibration, Stretch

AS_MANY = 0.9
"""Share of the matches agreeing with another camera that must still agree after its refinement, or with the map's instead."""
REFUTED = 0.5
"""Probability that the map's intrinsics are wrong above which they are not taken."""


def with_other_camera(
    query: LandmarkQuery, matches: LandmarkMatches, found: LandmarkPose, clock: Stopwatch
) -> LandmarkPose:
    """Return a pose, found again with another camera if far more of the ``matches`` by descriptors agree with that.

    Images from different cameras keep their given intrinsics.
    """
    if len({image.intrinsics for image in query.images}) > 1:
        return found
    better = found.better_camera
    clock.lap("camera")
    estimated = None if better is None else _estimated(query, matches, better, clock)
    if estimated is not None or (found.estimates_calibration and not _is_compared(query)):
        found = estimated or found
        return _like_map_camera(query, matches, found, clock) or found
    if found.agreeing < SUSPECTED * found.matches and not found.takes_map_camera:
        enough = SUPPORT_RATIO * found.agreeing + LEAST_EXTRA_INLIERS
        return sampled_with_map_camera(query, matches, enough, enough, clock) or found
    return found


def _is_compared(query: LandmarkQuery) -> bool:
    """Return whether the map's camera is so near the given one that the two were compared already."""
    camera, prior = query.map_camera, OTHER_CAMERA if query.prior == FIXED else query.prior
    return camera is not None and camera.is_near(prior)


def _estimated(
    query: LandmarkQuery, matches: LandmarkMatches, better: CameraFit, clock: Stopwatch
) -> LandmarkPose | None:
    """Return the pose with a camera estimated along with it; None if too few matches agree with it once errors are weighed."""
    seen = query.seen_by([better.stretch.applied(image.intrinsics) for image in query.images])
    first = Hypothesis(better.T_world_rig, better.inliers, 0, better.calibration)
    answer = refined_pose(seen, matches[better.inliers], first, ANY)
    found = described(seen, matches, answer, clock.seconds)
    clock.lap("camera")
    if found.agreeing < AS_MANY * better.agreeing:
        return None
    return replace(found, stretch=better.stretch, has_other_camera=True)


def _like_map_camera(
    query: LandmarkQuery, matches: LandmarkMatches, found: LandmarkPose, clock: Stopwatch
) -> LandmarkPose | None:
    """Return the pose with the map's intrinsics if the ones found resemble them and nothing refutes them."""
    given, count = query.images[-1].intrinsics, len(query.images)
    own, deviation = found.intrinsics_of(given), float(found.calibration_deviations[0])
    camera = None if own is None else camera_like(own, query.landmarks.cameras, deviation)
    if own is None or camera is None or found.takes_map_camera:
        return None
    data = query.seen_by([own] * count).observed(matches)
    off = data.without_motion(found.T_world_camera, found.motion).residuals(found.T_world_camera)
    first = Hypothesis(found.T_world_camera, torch.linalg.vector_norm(off, dim=-1) <= query.threshold, 0)
    return _with_map_camera(query, matches, camera, first, AS_MANY * found.agreeing, clock)


def sampled_with_map_camera(
    query: LandmarkQuery, matches: LandmarkMatches, consensus: float, enough: float, clock: Stopwatch
) -> LandmarkPose | None:
    """Return the pose by minimal samples with the map's camera, resized to the image whatever its shape.

    None unless at least ``consensus`` matches agree with the samples, and ``enough`` with the refined pose.
    """
    given = query.images[-1].intrinsics
    groups = stretched_cameras(query.landmarks.cameras, given.width, given.height)
    best = None
    for camera in dict.fromkeys(median_camera(group) for group in groups):
        if camera == given:
            continue
        data = query.seen_by([camera] * len(query.images)).observed(matches)
        first = sample_consensus(data, matches.view, query.threshold, seed=0)
        agreeing = 0 if first is None else int(first.inliers.sum())
        if first is not None and agreeing >= (consensus if best is None else best[2]):
            best = (camera, first, agreeing)
    return None if best is None else _with_map_camera(query, matches, best[0], best[1], enough, clock)


def _with_map_camera(
    query: LandmarkQuery,
    matches: LandmarkMatches,
    camera: Intrinsics,
    first: Hypothesis,
    enough: float,
    clock: Stopwatch,
) -> LandmarkPose | None:
    """Return the pose with the map's ``camera`` if ``enough`` matches agree and nothing refutes it."""
    correction = _correction(query.images[-1].intrinsics, camera)
    if correction is None or int(first.inliers.sum()) < LEAST_GUIDED_MATCHES:
        return None
    seen = replace(query.seen_by([camera] * len(query.images)), prior=FIXED)
    found = described(seen, matches, refined_pose(seen, matches[first.inliers], first), clock.seconds)
    clock.lap("map's camera")
    refuted = found.estimates_calibration or found.miscalibration.worst[1] > REFUTED
    if refuted or found.agreeing < enough:
        return None
    stretch, calibration = correction
    return replace(found, intrinsics=camera, calibration=calibration, stretch=stretch, has_other_camera=True)


def _correction(given: Intrinsics, camera: Intrinsics) -> tuple[Stretch, Calibration] | None:
    """Return how a camera differs from the given one; None if ``Calibration`` does not describe that."""
    across, down = math.log(camera.fx / given.fx), math.log(camera.fy / given.fy)
    for split in (split_stretch, least_change):  # without a stretch, if that describes it
        stretch, _ = split(across - down, 0.5 * (across + down))
        correction = correction_between(stretch.applied(given), camera)
        if correction is not None:
            return stretch, Calibration(*correction.tolist())
    return None
