"""Evidence that a capture's images were taken by moving cameras with a rolling shutter."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.camera import STILL, MotionPrior
from bidnerf_core.mapping import (
    ENOUGH_IMAGES,
    LEAST_VISIBLE_POINTS,
    TrackedKeypoints,
    log_evidence,
    resections,
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
    total = 0.0
    some = numbers[:: -(-len(numbers) // MOST_IMAGES)]
    for _, states, normal in resections(sightings, points, some, correlation, (STILL, prior)):
        still, moving = log_evidence(states, normal).view(2, -1)
        gain = (moving - still).clamp(-MOST_EVIDENCE, MOST_EVIDENCE)
        total += float(gain.nan_to_num(-MOST_EVIDENCE).sum())
    return prior if total > 0 else STILL
