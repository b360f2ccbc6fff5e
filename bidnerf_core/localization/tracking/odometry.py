"""Odometry: the motion between consecutive frames with depth, from corners that the optical flow follows."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from bidnerf_core.depth.sensors import UNKNOWN, DepthNoise
from bidnerf_core.frames.frame import Frame
from bidnerf_core.geometry.se3 import SE3
from bidnerf_core.localization.search.landmark_query import pixel_threshold
from bidnerf_core.localization.tracking.detection import flow_evidence
from bidnerf_core.localization.tracking.flow import Grey, corners
from bidnerf_core.localization.tracking.motion import Motion
from bidnerf_core.localization.tracking.points import FRESH, FollowedPoints, fit_pose
from bidnerf_core.mapping.landmarks.keypoint_depth import measured_depth

LEAST_CORNERS = 20
"""Least number of corners that must agree with a motion."""
LEAST_SHARE = 0.5
"""Least share of the corners that must agree with it."""
SIGNIFICANT_NFA = -6.0
"""Largest logarithm of the number of such agreements expected by chance."""
REPLENISHED = 0.5
"""Share of ``count`` below which new corners are detected."""
CORRELATION = 4.0
"""Number of corners that count as one, since the errors of neighbouring depths are correlated."""


@dataclass(frozen=True)
class Odometry:
    """Follows up to ``count`` corners whose depth was measured, with errors of this ``noise``."""

    count: int
    noise: DepthNoise = UNKNOWN.noise

    def moved(
        self, frame: Frame, points: FollowedPoints, motion: Motion, start: SE3, seconds: float
    ) -> tuple[Motion, FollowedPoints] | None:
        """Return the state ``seconds`` after ``motion`` and the corners that agree with it; None if they are too few.

        ``start`` is the predicted pose, at which the fit begins.
        """
        threshold = pixel_threshold(frame.intrinsics)
        found = fit_pose(points.observed(frame), start, threshold / 2, threshold, CORRELATION)
        if found is None:
            return None
        evidence = flow_evidence(found, frame.intrinsics)
        if (
            evidence.agreeing < max(LEAST_CORNERS, LEAST_SHARE * len(points))
            or evidence.log10_nfa > SIGNIFICANT_NFA
        ):
            return None
        relative = found.fit.covariance
        if not bool(relative.isfinite().all()):
            return None
        return motion.moved(found.T_world_camera, relative, seconds), points[found.inliers]

    def replenished(
        self, frame: Frame, image: Grey | None, points: FollowedPoints, T_world_camera: SE3
    ) -> FollowedPoints:
        """Return the corners among ``points``, or new ones at the pose of this frame where they have become few."""
        points = points[points.landmark == FRESH]
        if image is None or not frame.has_depth or len(points) >= REPLENISHED * self.count:
            return points
        apart = 0.7 * (image.shape[0] * image.shape[1] / self.count) ** 0.5
        pixels = corners(image, self.count, apart)
        depth = measured_depth(frame, pixels)
        pixels, depth = pixels[depth > 0], depth[depth > 0]
        ray = frame.intrinsics.unproject(pixels.double())
        across = 0.5 * depth / frame.intrinsics.fx
        return FollowedPoints(
            pixels,
            T_world_camera.apply(ray * depth[:, None]),
            torch.stack([across, self.noise.deviation(depth)], dim=-1),
            -T_world_camera.rotate(torch.nn.functional.normalize(ray, dim=-1)),
            torch.full((len(pixels),), FRESH, dtype=torch.long),
        )
