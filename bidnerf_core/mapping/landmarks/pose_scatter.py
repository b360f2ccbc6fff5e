"""The errors of the map's given poses, estimated by resecting its images from the triangulated points."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.geometry.robust import chi_squared_quantile
from bidnerf_core.geometry.se3 import SE3
from bidnerf_core.mapping.geometry.observations import ObservedPoints
from bidnerf_core.mapping.geometry.resection import resect
from bidnerf_core.mapping.geometry.triangulation import Sightings
from bidnerf_core.mapping.landmarks.landmark_fusion import TrackedKeypoints

LEAST_VISIBLE_POINTS = 20
"""Least number of points from which the pose of an image is estimated."""
ENOUGH_IMAGES = 8
"""Least number of images from which the 6x6 covariance is estimated."""
WEIGHT_ROUNDS = 10
"""Number of rounds of reweighting; after five, the weights hardly change."""


def pose_scatter(
    tracked: TrackedKeypoints, positions: Float[Tensor, "n 3"], noise: float
) -> Float[Tensor, "6 6"]:
    """Return the covariance of the right updates from given to resected poses; zero if there are too few images.

    ``noise`` is that of the keypoints, pixels. Each image takes part in triangulating the points that it sees, which biases
    them towards its own error. This is corrected for: if a point has k views, resection shows the factor 1 - 1/k of the pose
    variance, whereas the pose of a new image would show 1 + 1/k.
    """
    return update_scatter(list(pose_updates(tracked, positions, noise).values()))


def update_scatter(updates: Sequence[Float[Tensor, "6"] | None]) -> Float[Tensor, "6 6"]:
    """Return a robust covariance of pose updates; zero if there are too few, or fewer than half of the images have one."""
    known = [update for update in updates if update is not None]
    if len(known) < max(ENOUGH_IMAGES, len(updates) / 2):
        return torch.zeros((6, 6), dtype=torch.float64)
    return robust_covariance(torch.stack(known))


def pose_updates(
    tracked: TrackedKeypoints, positions: Float[Tensor, "n 3"], noise: float
) -> dict[int, Float[Tensor, "6"]]:
    """Return the right updates from given to resected poses of the images with enough points, by number of the image.

    They are corrected for each image's influence on its points, see ``pose_scatter``.
    """
    sightings, image = tracked.sightings, tracked.image
    seen = torch.bincount(sightings.point)[sightings.point].double()
    updates = {}
    for number in (torch.bincount(image) >= LEAST_VISIBLE_POINTS).nonzero()[:, 0].tolist():
        own = (image == number).nonzero()[:, 0]
        T = tracked.images[number].T_world_camera
        views = float(seen[own].mean())
        found = resect(observed_at_rest(sightings[own], positions, T), T, noise)
        update = (T.inverse() @ found.T_world_rig).log()
        updates[number] = update * ((1 + 1 / views) / (1 - 1 / views)) ** 0.5
    return updates


def observed_at_rest(sightings: Sightings, positions: Float[Tensor, "n 3"], T: SE3) -> ObservedPoints:
    """Return the points displaced so that a camera at rest at the pose ``T`` observes them where the moving one did."""
    count = len(sightings)
    zeros = torch.zeros((count, 3), dtype=torch.float64)
    eye = torch.eye(3, dtype=torch.float64).expand(count, 3, 3)
    return ObservedPoints(
        T.apply(sightings.in_camera(positions)), zeros[:, :2], zeros + torch.tensor([0.0, 0.0, 1.0]),
        sightings.image, sightings.focal, zeros[:, 0], eye, zeros, zeros[:, 0], zeros[:, 0],
    )  # fmt: skip


def robust_covariance(values: Float[Tensor, "n c"]) -> Float[Tensor, "c c"]:
    """Return an M-estimate of the covariance about zero (Maronna 1976).

    Weights bound the influence of each value. The scale is such that half of the squared Mahalanobis distances are below the
    median of the chi-squared distribution.
    """
    channels = values.shape[1]
    scale = values.square().median(0).values.clamp(min=1e-30)
    covariance = torch.diag(scale)
    for _ in range(WEIGHT_ROUNDS):
        squared = (values @ torch.linalg.inv(covariance) * values).sum(-1).clamp(min=1e-12)
        squared = squared * (chi_squared_quantile(0.5, channels) / float(squared.median()))
        weight = 1 / (1 + squared / channels)
        covariance = (values.mT * weight) @ values / weight.sum() + 1e-9 * torch.diag(scale)
    squared = (values @ torch.linalg.inv(covariance) * values).sum(-1)
    covariance = covariance * (float(squared.median()) / chi_squared_quantile(0.5, channels))
    return (covariance + covariance.mT) / 2
