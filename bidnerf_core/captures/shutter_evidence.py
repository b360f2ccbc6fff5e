"""Evidence that a capture's images were taken by moving cameras with a rolling shutter."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.camera import STILL, MotionPrior
from bidnerf_core.mapping import (
    ENOUGH_IMAGES,
    LEAST_VISIBLE_POINTS,
    TrackedKeypoints,
    log_motion_evidence,
    noise,
    observed_at_rest,
    resect,
)

MOST_IMAGES = 60
"""Largest number of images examined, spread over the capture."""
MOST_EVIDENCE = 10.0
"""Largest contribution of an image to the log evidence for or against a motion, so that no few images decide."""


def common_motion(seen: TrackedKeypoints, points: Float[Tensor, "n 3"], correlation: float) -> MotionPrior:
    """Return the prior of the cameras' motions if a rolling shutter is more probable, else ``STILL``.

    The hypotheses concern the capture as a whole: either all images have a rolling shutter, or none. Each
    image is resected from ``points`` with and without a motion. ``correlation`` is the number of keypoints
    that count as one.
    """
    sightings, image = seen.sightings, seen.image
    numbers = (torch.bincount(image) >= LEAST_VISIBLE_POINTS).nonzero()[:, 0]
    if len(numbers) < ENOUGH_IMAGES:
        return STILL
    prior = MotionPrior.usual(float(sightings.in_camera(points)[:, 2].median()))
    pixel_noise, total = noise(sightings, points), 0.0
    for number in numbers[:: -(-len(numbers) // MOST_IMAGES)].tolist():
        own = (image == number).nonzero()[:, 0]
        T = seen.images[number].T_ref_camera
        data = observed_at_rest(sightings[own], points, T)
        still = resect(data, T, pixel_noise, correlation=correlation)
        moving = resect(data, T, pixel_noise, correlation=correlation, motion=prior)
        evidence = log_motion_evidence(data, moving, still, prior, correlation)
        total += (
            min(MOST_EVIDENCE, max(-MOST_EVIDENCE, evidence)) if math.isfinite(evidence) else -MOST_EVIDENCE
        )
    return prior if total > 0 else STILL
