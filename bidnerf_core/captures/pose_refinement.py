"""Refinement of the images' given poses from the keypoints they share."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.camera import STILL, MotionPrior
from bidnerf_core.captures.cameras import PoseConsistency
from bidnerf_core.captures.shutter_evidence import common_motion
from bidnerf_core.geometry import KEYPOINTS_PER_INDEPENDENT, SE3, mad_deviation
from bidnerf_core.mapping import (
    ENOUGH_IMAGES,
    LEAST_NOISE,
    Adjustment,
    LandmarkConfig,
    PosePrior,
    TrackedKeypoints,
    TrackedViews,
    adjusted,
    noise,
    pinhole,
    pose_updates,
)

ROUNDS = 3
"""Largest number of adjustments. After each, the keypoints are rematched, which finds matches that wrong
poses prevented."""
SETTLED_PIXELS = 0.25
"""Largest image motion (pixels) in an adjustment at which iteration stops."""
LEAST_DEVIATION = 1e-9
"""Smallest standard deviation of the poses (metres, radians) that is assumed."""


@dataclass(frozen=True, eq=False)
class AdjustedPoses:
    """The poses that fit the keypoints best, and how well the given ones do."""

    tracked: TrackedViews  # with these poses, and rematched with them
    pixels: Float[Tensor, "v"]  # median shift in each image of the points that it shows; 0 without points
    consistency: PoseConsistency  # of the given poses


def adjusted_poses(
    tracked: TrackedViews,
    config: LandmarkConfig,
    least: float = 0.0,
) -> AdjustedPoses | None:
    """Adjust the poses of ``tracked`` images and the points that they show; None if there are too few of
    either.

    The errors of the given poses are assumed to be independent, and as large as resection of the images
    suggests. This prior alone fixes the gauge (position, orientation and scale of the whole), so the mean
    motion of the images is about zero. If the keypoints show a rolling shutter, the motions of the cameras
    during readout are estimated too. Otherwise, if the first adjustment finds an inconsistency of less than
    ``least`` pixels, its poses are returned at once.
    """
    given = tracked.T_world_camera
    seen, points = tracked.triangulated(config)
    before = max(LEAST_NOISE, noise(seen.sightings, points))
    deviations = _deviations(seen, points)
    if deviations is None:
        return None
    motion = STILL
    for number in range(ROUNDS):
        prior = PosePrior(given, *deviations, motion)
        start = Adjustment(tracked.T_world_camera, points, tracked.motion)
        pixel_noise = max(LEAST_NOISE, noise(seen.sightings, points))
        fit = adjusted(seen.sightings, start, prior, pixel_noise, KEYPOINTS_PER_INDEPENDENT)
        step = _motion(seen, fit.points, tracked.T_world_camera, fit.T_world_camera)
        moved = (given.inverse() @ fit.T_world_camera).log()
        deviations = max(deviations[0], _spread(moved[:, :3])), max(deviations[1], _spread(moved[:, 3:]))
        pixels = _motion(seen, fit.points, given, fit.T_world_camera)
        tracked = tracked.at(fit.T_world_camera, fit.motion)
        noticed = False
        if motion == STILL and number < ROUNDS - 1:  # later ones could no longer be estimated
            motion = _common_motion(tracked, config)
            noticed = motion != STILL
        if number == 0 and not noticed:
            found = _found(tracked, pixels, before, config)
            if found.consistency.inconsistency < least:
                return found
        tracked = tracked.matched_anew(config)
        if float(step.max()) <= SETTLED_PIXELS and not noticed:
            break
        seen, points = tracked.triangulated(config)
    return _found(tracked, pixels, before, config)


def _common_motion(tracked: TrackedViews, config: LandmarkConfig) -> MotionPrior:
    return common_motion(*tracked.triangulated(config), KEYPOINTS_PER_INDEPENDENT)


def _found(
    tracked: TrackedViews, pixels: Float[Tensor, "v"], before: float, config: LandmarkConfig
) -> AdjustedPoses:
    seen, points = tracked.triangulated(config)
    after = max(LEAST_NOISE, noise(seen.sightings, points))
    return AdjustedPoses(tracked, pixels, PoseConsistency(before, after))


def _deviations(seen: TrackedKeypoints, points: Float[Tensor, "n 3"]) -> tuple[float, float] | None:
    """Return the standard deviations of the given poses (metres, radians) along and about each axis."""
    updates = list(pose_updates(seen, points).values())
    if len(updates) < ENOUGH_IMAGES:
        return None
    values = torch.stack(updates)
    return _spread(values[:, :3]), _spread(values[:, 3:])


def _spread(values: Float[Tensor, "v 3"]) -> float:
    """Return a robust standard deviation about zero."""
    return max(LEAST_DEVIATION, mad_deviation(values))


def _motion(
    seen: TrackedKeypoints, points: Float[Tensor, "n 3"], given: SE3, found: SE3
) -> Float[Tensor, "v"]:
    """Return the median shift (pixels) of each image's points between its given and its found pose."""
    shown, image = points[seen.point], seen.image
    focal = seen.sightings.focal[:, None]
    places = [pinhole(T[image].inverse().apply(shown))[0] * focal for T in (given, found)]
    away = torch.linalg.vector_norm(places[1] - places[0], dim=-1)
    medians = torch.zeros(len(seen.images), dtype=torch.float64)
    for number in image.unique().tolist():
        medians[number] = away[image == number].median()
    return medians
