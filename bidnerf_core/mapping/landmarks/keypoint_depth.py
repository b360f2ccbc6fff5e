"""Back-projection of keypoints by their measured depth."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from bidnerf_core.depth import UNKNOWN
from bidnerf_core.geometry import mad_deviation
from bidnerf_core.mapping.geometry.observations import summed
from bidnerf_core.mapping.landmarks.tracks import TrackedKeypoints

ENOUGH_DEPTHS = 30
"""Minimum number of triangulated observations with depth from which the depth noise is estimated."""


def keypoint_depth_noise(observations: TrackedKeypoints, points: Float[Tensor, "n 3"]) -> float:
    """Return a robust relative standard deviation of measured depth, from triangulated points.

    If there are too few, return that of an unknown sensor.
    """
    depth = observations.depth
    known = depth > 0
    if int(known.sum()) < ENOUGH_DEPTHS:
        return UNKNOWN.noise.linear
    off = depth[known] / observations.sightings.in_camera(points)[known, 2] - 1
    return max(1e-4, mad_deviation(off))


def depth_ratio(observations: TrackedKeypoints, points: Float[Tensor, "n 3"]) -> float | None:
    """Return the median ratio of measured depth to the depth of triangulated points; None if there are too few."""
    z, depth = observations.sightings.in_camera(points)[:, 2], observations.depth
    known = (depth > 0) & (z > 0)
    return float((depth[known] / z[known]).median()) if int(known.sum()) >= ENOUGH_DEPTHS else None


def placed(
    observations: TrackedKeypoints, relative: float, pixel_noise: float
) -> tuple[TrackedKeypoints, Float[Tensor, "n 3"], Float[Tensor, "n 3 3"]]:
    """Return the inliers, the weighted mean of each track's back-projected points (metres, world), and its covariance.

    ``relative`` is the relative noise of the depth, and ``pixel_noise`` that of the keypoints (pixels). Tracks without a
    majority of inliers are dropped.
    """
    observations, _ = observations[observations.depth > 0].compacted()
    sightings, depth = observations.sightings, observations.depth
    ray = torch.cat([sightings.image, torch.ones_like(sightings.image[:, :1])], dim=-1) * depth[:, None]
    world = (sightings.rotation.mT @ ray[..., None])[..., 0] + sightings.centre
    # The noise of depth is along the ray, and that of the keypoint across it.
    d = sightings.directions()
    along = d[:, :, None] * d[:, None]
    sideways = (pixel_noise * depth / sightings.focal) ** -2
    information = (torch.eye(3, dtype=d.dtype) - along) * sideways[:, None, None]
    information = along * ((relative * depth) ** -2)[:, None, None] + information
    mean, _ = _weighted(world, information, observations.point)
    off = (world - mean[observations.point])[..., None]
    agree = (off.mT @ information @ off)[:, 0, 0] <= 3**2  # three standard deviations
    tracks = torch.bincount(observations.point)
    majority = 2 * torch.bincount(observations.point[agree], minlength=len(tracks)) > tracks
    kept = agree & majority[observations.point]
    observations, _ = observations[kept].compacted()
    return observations, *_weighted(world[kept], information[kept], observations.point)


def _weighted(
    values: Float[Tensor, "m 3"], information: Float[Tensor, "m 3 3"], point: Int[Tensor, "m"]
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3 3"]]:
    """Return each point's weighted mean of its values, and its covariance."""
    count = int(point.max()) + 1 if len(point) else 0
    total = summed(information, point, count)
    weighted = summed((information @ values[..., None])[..., 0], point, count)
    covariance = torch.linalg.inv(total)
    return (covariance @ weighted[..., None])[..., 0], covariance
