"""Refinement of the images' given poses from the keypoints they share."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.camera import STILL, MotionPrior
from bidnerf_core.captures.cameras import PoseRefinement
from bidnerf_core.geometry import KEYPOINTS_PER_INDEPENDENT, SE3, mad_deviation
from bidnerf_core.mapping import (
    ENOUGH_IMAGES,
    LEAST_NOISE,
    LEAST_VISIBLE_POINTS,
    Adjustment,
    LandmarkConfig,
    PosePrior,
    TrackedKeypoints,
    TrackedViews,
    adjusted,
    log_evidence,
    noise,
    pinhole,
    pose_updates,
    resections,
)

ROUNDS = 3
"""Largest number of adjustments. After each, the keypoints are rematched, which finds matches that wrong
poses prevented."""
MOST_EVIDENCE = 10.0
"""Largest contribution of an image to the log evidence for or against a motion, so that no few images decide."""


def adjusted_poses(
    tracked: TrackedViews, config: LandmarkConfig, least: float = 0.0
) -> tuple[TrackedViews, Float[Tensor, "v"], PoseRefinement] | None:
    """Adjust the poses of ``tracked`` images and the points that they show; None if there are too few of either.

    Returns the tracks with these poses, rematched with them; the median shift (pixels) in each image of the points that it
    shows, 0 without points; and how well the given poses and these fit the keypoints.

    The errors of the given poses are assumed to be independent, and as large as resection of the images
    suggests. This prior alone fixes the gauge (position, orientation and scale of the whole), so the mean
    motion of the images is about zero. If the keypoints show a rolling shutter, the motions of the cameras
    during readout are estimated too. Otherwise, if the first adjustment finds an inconsistency of less than
    ``least`` pixels, its poses are returned at once.
    """
    given = tracked.T_world_camera
    seen, points = tracked.triangulated(config)
    before = max(LEAST_NOISE, noise(seen.sightings, points))
    updates = list(pose_updates(seen, points).values())
    if len(updates) < ENOUGH_IMAGES:
        return None
    deviations = _deviations(torch.stack(updates))
    motion = STILL
    for number in range(ROUNDS):
        start = Adjustment(tracked.T_world_camera, points, tracked.motion)
        pixel_noise = max(LEAST_NOISE, noise(seen.sightings, points))
        prior = PosePrior(given, *deviations, motion)
        fit = adjusted(seen.sightings, start, prior, pixel_noise, KEYPOINTS_PER_INDEPENDENT)
        step = _image_motion(seen, fit.points, tracked.T_world_camera, fit.T_world_camera)
        moved = _deviations((given.inverse() @ fit.T_world_camera).log())
        deviations = max(deviations[0], moved[0]), max(deviations[1], moved[1])
        pixels = _image_motion(seen, fit.points, given, fit.T_world_camera)
        tracked = tracked.at(fit.T_world_camera, fit.motion)
        noticed = False
        if motion == STILL and number < ROUNDS - 1:  # later ones could no longer be estimated
            motion = common_motion(*tracked.triangulated(config), KEYPOINTS_PER_INDEPENDENT)
            noticed = motion != STILL
        if number == 0 and not noticed:
            consistency = _consistency(tracked, before, config)
            if consistency.inconsistency < least:
                return tracked, pixels, consistency
        tracked = tracked.matched_anew(config)
        if float(step.max()) <= 0.25 and not noticed:  # pixels
            break
        seen, points = tracked.triangulated(config)
    return tracked, pixels, _consistency(tracked, before, config)


def _consistency(tracked: TrackedViews, before: float, config: LandmarkConfig) -> PoseRefinement:
    seen, points = tracked.triangulated(config)
    return PoseRefinement(before, max(LEAST_NOISE, noise(seen.sightings, points)))


def _deviations(updates: Float[Tensor, "v 6"]) -> tuple[float, float]:
    """Return robust standard deviations about zero (metres, radians) of pose updates, along and about each axis."""
    return max(1e-9, mad_deviation(updates[:, :3])), max(1e-9, mad_deviation(updates[:, 3:]))


def _image_motion(
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


def common_motion(seen: TrackedKeypoints, points: Float[Tensor, "n 3"], correlation: float) -> MotionPrior:
    """Return the prior of the cameras' motions if a rolling shutter is more probable, else ``STILL``.

    The hypotheses concern the capture as a whole: either all images have a rolling shutter, or none. Each of up to 60
    images is resected from ``points`` with and without a motion. ``correlation`` is the number of keypoints
    that count as one.
    """
    sightings = seen.sightings
    numbers = (torch.bincount(seen.image) >= LEAST_VISIBLE_POINTS).nonzero()[:, 0]
    if len(numbers) < ENOUGH_IMAGES:
        return STILL
    prior = MotionPrior.usual(float(sightings.in_camera(points)[:, 2].median()))
    total, some = 0.0, numbers[:: -(-len(numbers) // 60)]
    for _, states, normal in resections(sightings, points, some, correlation, (STILL, prior)):
        still, moving = log_evidence(states, normal).view(2, -1)
        gain = (moving - still).clamp(-MOST_EVIDENCE, MOST_EVIDENCE)
        total += float(gain.nan_to_num(-MOST_EVIDENCE).sum())
    return prior if total > 0 else STILL
