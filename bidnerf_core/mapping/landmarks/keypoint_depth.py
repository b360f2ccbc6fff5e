"""Back-projection of keypoints by their measured depth."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from bidnerf_core.depth.sensors import UNKNOWN
from bidnerf_core.frames.frame import Frame
from bidnerf_core.geometry.robust import mad_deviation
from bidnerf_core.mapping.geometry.observations import Sightings
from bidnerf_core.mapping.landmarks.tracks import TrackedKeypoints

DEPTH_EDGE = 0.05
"""Largest relative change of the depth around a keypoint; more indicates a depth edge."""
LEAST_MEASURED = 6
"""Minimum number of the nine pixels around a keypoint that must have measured depth."""
ENOUGH_DEPTHS = 30
"""Minimum number of triangulated observations with depth from which the depth noise is estimated."""
OUTLIER_DEVIATIONS = 3.0
"""Distance from the track's mean, in standard deviations, beyond which a depth is an outlier."""


def measured_depth(frame: Frame, pixels: Float[Tensor, "n 2"]) -> Float[Tensor, "n"]:
    """Return the median depth (metres) of the 3x3 pixels around each of ``pixels`` (u, v).

    It is 0 at depth edges and where too few pixels have measured depth.
    """
    if frame.depth is None or not len(pixels):
        return torch.zeros(len(pixels), dtype=torch.float64)
    depth = frame.depth.detach().cpu().double()
    height, width = depth.shape
    u, v = pixels.floor().long().unbind(-1)
    step = torch.tensor([-1, 0, 1])
    rows = (v[:, None, None] + step[:, None]).clamp(0, height - 1)
    columns = (u[:, None, None] + step).clamp(0, width - 1)
    around = depth[rows, columns].flatten(1)
    around = torch.where(around.isfinite() & (around > 0), around, torch.nan)
    median = around.nanmedian(dim=1).values
    known = around.isfinite()
    low = torch.where(known, around, torch.inf).amin(1)
    high = torch.where(known, around, 0).amax(1)
    smooth = (known.sum(1) >= LEAST_MEASURED) & (high - low <= DEPTH_EDGE * median)
    return torch.where(smooth, median, 0)


def keypoint_depth_noise(
    sightings: Sightings, points: Float[Tensor, "n 3"], depth: Float[Tensor, "m"]
) -> float:
    """Return a robust relative standard deviation of measured depth, from triangulated points.

    If there are too few, return that of an unknown sensor.
    """
    known = depth > 0
    if int(known.sum()) < ENOUGH_DEPTHS:
        return UNKNOWN.noise.linear
    off = depth[known] / sightings.in_camera(points)[known, 2] - 1
    return max(1e-4, mad_deviation(off))


def depth_ratio(
    sightings: Sightings, points: Float[Tensor, "n 3"], depth: Float[Tensor, "m"]
) -> float | None:
    """Return the median ratio of measured depth to the depth of triangulated points; None if there are too few."""
    z = sightings.in_camera(points)[:, 2]
    known = (depth > 0) & (z > 0)
    return float((depth[known] / z[known]).median()) if int(known.sum()) >= ENOUGH_DEPTHS else None


def placed(
    observations: TrackedKeypoints, depth: Float[Tensor, "m"], relative: float, pixel_noise: float
) -> tuple[TrackedKeypoints, Float[Tensor, "n 3"], Float[Tensor, "n 3 3"]]:
    """Return the inliers, the weighted mean of each track's back-projected points (metres, world), and its covariance.

    ``depth`` is the depth measured at each observation (metres, 0: none), ``relative`` its relative noise, and
    ``pixel_noise`` that of the keypoints (pixels). Tracks without a majority of inliers are dropped.
    """
    observations, _ = observations[depth > 0].compacted()
    sightings, depth = observations.sightings, depth[depth > 0]
    ray = torch.cat([sightings.image, torch.ones_like(sightings.image[:, :1])], dim=-1) * depth[:, None]
    world = (sightings.rotation.mT @ ray[..., None])[..., 0] + sightings.centre
    information = _information(sightings, depth, relative, pixel_noise)
    mean, _ = _weighted(world, information, observations.point)
    off = (world - mean[observations.point])[..., None]
    agree = (off.mT @ information @ off)[:, 0, 0] <= OUTLIER_DEVIATIONS**2
    tracks = torch.bincount(observations.point)
    majority = 2 * torch.bincount(observations.point[agree], minlength=len(tracks)) > tracks
    kept = agree & majority[observations.point]
    observations, _ = observations[kept].compacted()
    return observations, *_weighted(world[kept], information[kept], observations.point)


def _information(
    sightings: Sightings, depth: Float[Tensor, "m"], relative: float, pixel_noise: float
) -> Float[Tensor, "m 3 3"]:
    """Return the inverse covariance of back-projected points: depth noise along the ray, keypoint noise across it."""
    d = sightings.directions()
    along = d[:, :, None] * d[:, None]
    across = torch.eye(3, dtype=d.dtype) - along
    sideways = (pixel_noise * depth / sightings.focal) ** -2
    return along * ((relative * depth) ** -2)[:, None, None] + across * sideways[:, None, None]


def _weighted(
    values: Float[Tensor, "m 3"], information: Float[Tensor, "m 3 3"], point: Int[Tensor, "m"]
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3 3"]]:
    """Return each point's weighted mean of its values, and its covariance."""
    count = int(point.max()) + 1 if len(point) else 0
    total = torch.zeros((count, 3, 3), dtype=values.dtype).index_add_(0, point, information)
    weighted = (information @ values[..., None])[..., 0]
    summed = torch.zeros((count, 3), dtype=values.dtype).index_add_(0, point, weighted)
    covariance = torch.linalg.inv(total)
    return (covariance @ summed[..., None])[..., 0], covariance
