"""The images of a query, the landmarks to find in them, and the prior on the camera."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from bidnerf_core.camera import Intrinsics
from bidnerf_core.localization.landmarks.correspondences import LandmarkMatches, observed_points
from bidnerf_core.localization.landmarks.hypotheses import Hypothesis, Stated, camera_hypotheses
from bidnerf_core.localization.landmarks.map_camera import MapCamera, map_cameras
from bidnerf_core.mapping import (
    FIXED,
    CalibrationPrior,
    ImageKeypoints,
    LandmarkMap,
    ObservedPoints,
    paired_squared_distances,
)

THRESHOLD = 0.005
"""Maximum reprojection error of an inlier, as a fraction of the image's diagonal; at least 2 pixels."""

MAX_DISTANCE = 0.6
"""Maximum descriptor distance of a guided match, in units of the distance between descriptors of different landmarks."""


@dataclass(frozen=True, eq=False)
class LandmarkQuery:
    """The images of a query, the landmarks to find in them, and the prior on the camera."""

    images: list[ImageKeypoints]
    landmarks: LandmarkMap
    prior: CalibrationPrior
    moving: bool = True  # whether the camera of a single image may have moved during the readout

    @property
    def may_move(self) -> bool:
        """Whether a motion is estimated; a rig counts as static, since its views may be from different times."""
        return self.moving and len(self.images) == 1

    @property
    def threshold(self) -> float:
        """The maximum reprojection error of an inlier, pixels."""
        return pixel_threshold(self.images[-1].intrinsics)

    @property
    def max_distance(self) -> float:
        """The maximum squared descriptor distance of a guided match."""
        return (MAX_DISTANCE * self.landmarks.unrelated_distance) ** 2

    @property
    def map_cameras(self) -> list[MapCamera]:
        """The cameras of the map's images; empty unless all images of the query have the same intrinsics."""
        given = {image.intrinsics for image in self.images}
        if len(given) > 1:
            return []
        return map_cameras(given.pop(), self.landmarks.cameras, crops=self.prior != FIXED)

    @property
    def hypotheses(self) -> list[Hypothesis]:
        """The hypotheses about the camera; for images from different cameras, only that the stated intrinsics are right."""
        every = camera_hypotheses(self.map_cameras, self.prior)
        if len({image.intrinsics for image in self.images}) == 1:
            return every
        return [each for each in every if each.name == Stated.EXACT]

    def seen_by(self, cameras: Sequence[Intrinsics]) -> LandmarkQuery:
        """Return the query with other intrinsics for each of its images."""
        images = [
            replace(image, intrinsics=camera, rays=camera.unproject(image.keypoints.pixels.double()))
            for image, camera in zip(self.images, cameras, strict=True)
        ]
        return replace(self, images=images)

    def observed(self, matches: LandmarkMatches) -> ObservedPoints:
        """Return the landmarks and keypoints of ``matches`` as input for a pose solver."""
        return observed_points(self.images, self.landmarks, matches)

    def descriptors(self, matches: LandmarkMatches) -> UInt8[Tensor, "m d"]:
        """Return the descriptors of the keypoints of ``matches``."""
        return torch.cat([image.keypoints.descriptors for image in self.images])[self._number(matches)]

    def squared_distances(self, matches: LandmarkMatches) -> Float[Tensor, "m"]:
        """Return the squared descriptor distance of each match."""
        descriptors = torch.cat([image.keypoints.descriptors for image in self.images])
        number = self._number(matches)
        return paired_squared_distances(descriptors, self.landmarks.descriptors, number, matches.landmark)

    def pixels(self, matches: LandmarkMatches) -> Float[Tensor, "m 2"]:
        """Return the pixels of the keypoints of ``matches``."""
        return torch.cat([image.keypoints.pixels for image in self.images])[self._number(matches)]

    def _number(self, matches: LandmarkMatches) -> Int[Tensor, "m"]:
        first = torch.tensor([0, *(len(image.keypoints) for image in self.images)]).cumsum(0)
        return first[matches.view] + matches.keypoint


def pixel_threshold(camera: Intrinsics) -> float:
    """Return the maximum reprojection error of an inlier, pixels."""
    return max(2.0, THRESHOLD * math.hypot(camera.width, camera.height))
