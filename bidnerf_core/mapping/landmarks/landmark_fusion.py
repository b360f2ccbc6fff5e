"""Fusing the keypoints that show a point into one landmark."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from bidnerf_core.camera.rolling_shutter import poses_of_rows
from bidnerf_core.frames.frame import SeenLandmarks
from bidnerf_core.geometry.se3 import SE3
from bidnerf_core.mapping.geometry.triangulation import Sightings
from bidnerf_core.mapping.landmarks.landmark_map import LandmarkMap
from bidnerf_core.mapping.landmarks.tracks import PosedKeypoints


@dataclass(frozen=True, eq=False)
class TrackedKeypoints:
    """Keypoints and the points that they show. One numbering, image by image, covers the keypoints of all images."""

    images: Sequence[PosedKeypoints]
    point: Int[Tensor, "m"]
    number: Int[Tensor, "m"]  # of the keypoint

    def __getitem__(self, index: Tensor) -> TrackedKeypoints:
        return TrackedKeypoints(self.images, self.point[index], self.number[index])

    def compacted(self) -> tuple[TrackedKeypoints, Int[Tensor, "n"]]:
        """Renumber the remaining points from 0, and return their former numbers as well."""
        found, point = self.point.unique(return_inverse=True)
        return TrackedKeypoints(self.images, point, self.number), found

    @property
    def count(self) -> int:
        """The number of points."""
        return int(self.point.max()) + 1 if len(self.point) else 0

    @property
    def image(self) -> Int[Tensor, "m"]:
        last = torch.tensor([len(image.keypoints) for image in self.images]).cumsum(0)
        return torch.searchsorted(last, self.number, right=True)

    @property
    def exposure_times(self) -> Float[Tensor, "m"]:
        """The times at which the keypoints were exposed, see ``rolling_shutter``."""
        return torch.cat([p.exposure_times for p in self.images])[self.number]

    @property
    def motion(self) -> Float[Tensor, "v 6"]:
        """The motion of each image's camera while its rows were exposed."""
        return torch.stack([p.motion for p in self.images])

    @property
    def sightings(self) -> Sightings:
        """The keypoints as observations by cameras at the poses at which their rows were exposed."""
        image, motion = self.image, self.motion
        T = SE3.stack([p.T_world_camera for p in self.images])[image]
        if bool(motion.any()):
            T = T @ poses_of_rows(self.exposure_times, motion[image])
        focal = torch.tensor([p.focal for p in self.images], dtype=torch.float64)
        rays = torch.cat([p.rays for p in self.images])[self.number]
        return Sightings(self.point, T.rotation.mT, T.translation, rays[:, :2], focal[image])

    @property
    def sizes(self) -> Float[Tensor, "m"]:
        """The diameters of the keypoints, pixels."""
        return torch.cat([p.keypoints.sizes for p in self.images])[self.number]

    @property
    def descriptors(self) -> UInt8[Tensor, "m d"]:
        return torch.cat([p.keypoints.descriptors for p in self.images])[self.number]


def fused_landmarks(
    observations: TrackedKeypoints,
    positions: Float[Tensor, "n 3"],
    covariance: Float[Tensor, "n 3 3"],
    noise: float,
) -> LandmarkMap:
    """Return landmarks at ``positions`` (metres, world) with their covariance; each of them needs an observation.

    ``noise`` is that of a keypoint, in pixels. The poses of the images are taken as exact: ``pose_covariance`` is 0.
    """
    count, sightings = len(positions), observations.sightings
    away = sightings.centre - positions[sightings.point]
    towards = away / torch.linalg.vector_norm(away, dim=-1, keepdim=True).clamp(min=1e-300)
    mean = _mean(towards, sightings.point, count)
    directions = mean / torch.linalg.vector_norm(mean, dim=-1, keepdim=True).clamp(min=1e-300)
    cosine = (towards * directions[sightings.point]).sum(-1).clamp(-1, 1)
    least = torch.ones(count, dtype=cosine.dtype).scatter_reduce(0, sightings.point, cosine, "amin")
    metres = observations.sizes * sightings.in_camera(positions)[:, 2].clamp(min=0) / sightings.focal
    return LandmarkMap(
        positions.float(),
        _across_and_along(covariance, directions).float(),
        _mean_descriptors(observations.descriptors, sightings.point, count),
        directions.float(),
        least.acos().float(),
        _mean(metres[:, None], sightings.point, count)[:, 0].float(),
        torch.bincount(sightings.point, minlength=count).int(),
        noise,
        torch.zeros((6, 6), dtype=torch.float64),
    )


def seen_landmarks(
    observations: TrackedKeypoints, positions: Float[Tensor, "n 3"], covariance: Float[Tensor, "n 3 3"]
) -> list[SeenLandmarks]:
    """Return the landmarks at ``positions`` (metres, world) that each image shows, with the deviation of their distance."""
    sightings, image = observations.sightings, observations.image
    away = positions[sightings.point] - sightings.centre
    distance = torch.linalg.vector_norm(away, dim=-1)
    ray = away / distance[:, None].clamp(min=1e-300)
    variance = (ray[:, None] @ covariance[sightings.point] @ ray[..., None])[:, 0, 0]
    pixels = torch.cat([p.keypoints.pixels for p in observations.images])[observations.number]
    parts = pixels.float(), distance.float(), variance.clamp(min=0).sqrt().float()
    return [SeenLandmarks(*(part[image == i] for part in parts)) for i in range(len(observations.images))]


def _across_and_along(
    covariance: Float[Tensor, "n 3 3"], directions: Float[Tensor, "n 3"]
) -> Float[Tensor, "n 2"]:
    """Return the standard deviations across a direction (the variances of both axes averaged) and along it."""
    along = (directions[:, None] @ covariance @ directions[..., None])[:, 0, 0]
    across = (covariance.diagonal(dim1=-2, dim2=-1).sum(-1) - along) / 2
    return torch.stack([across, along], dim=-1).clamp(min=0).sqrt()


def _mean_descriptors(
    descriptors: UInt8[Tensor, "m d"], point: Int[Tensor, "m"], count: int
) -> UInt8[Tensor, "n d"]:
    """Return mean descriptors, rescaled to the mean length, since a shorter descriptor is nearer to all others."""
    values = descriptors.float()
    mean = _mean(values, point, count)
    length = _mean(torch.linalg.vector_norm(values, dim=-1, keepdim=True), point, count)
    scaled = mean * length / torch.linalg.vector_norm(mean, dim=-1, keepdim=True).clamp(min=1e-9)
    return scaled.round().clamp(0, 255).to(torch.uint8)


def _mean(values: Float[Tensor, "m c"], index: Int[Tensor, "m"], count: int) -> Float[Tensor, "n c"]:
    total = torch.zeros((count, values.shape[1]), dtype=values.dtype).index_add_(0, index, values)
    return total / torch.bincount(index, minlength=count).clamp(min=1)[:, None]
