"""Correspondences between the keypoints of a rig's images and landmarks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from bidnerf_core.frames import View
from bidnerf_core.geometry import SE3
from bidnerf_core.mapping import Features, ImageKeypoints, LandmarkMap, ObservedPoints, image_keypoints

MIN_MATCHES = 6
"""Minimum number of correspondences from which a pose, or a scale of measured depth, is estimated."""
MAX_AMBIGUITY = 0.9
"""Maximum ratio of the descriptor distances of the best and the second-best candidate for a match (Lowe 2004, section 7.1)."""


def query_images(views: Sequence[View], features: Features) -> list[ImageKeypoints]:
    """Detect the keypoints of ``views``, with poses in any common frame; the rig's frame is that of the last camera."""
    images = [image_keypoints(view, features) for view in views]
    T_rig_ref = images[-1].T_ref_camera.inverse()
    return [replace(image, T_ref_camera=(T_rig_ref @ image.T_ref_camera).normalized()) for image in images]


@dataclass(frozen=True, eq=False)
class LandmarkMatches:
    """Matches: each row is a view, one of its keypoints, and the landmark matched with it."""

    view: Int[Tensor, "m"]
    keypoint: Int[Tensor, "m"]
    landmark: Int[Tensor, "m"]
    ambiguity: Float[Tensor, "m"]  # ratio of the best to the second-best descriptor distance

    def __len__(self) -> int:
        return len(self.view)

    @property
    def keys(self) -> Int[Tensor, "m"]:
        """A unique number for each match by its view (up to 512), keypoint (up to a million) and landmark."""
        return (self.view << 54) + (self.keypoint << 34) + self.landmark

    def __getitem__(self, index: Tensor) -> LandmarkMatches:
        return LandmarkMatches(
            self.view[index], self.keypoint[index], self.landmark[index], self.ambiguity[index]
        )

    @staticmethod
    def cat(parts: Sequence[LandmarkMatches]) -> LandmarkMatches:
        names = ("view", "keypoint", "landmark", "ambiguity")
        return LandmarkMatches(*(torch.cat([getattr(part, name) for part in parts]) for name in names))


def observed_points(
    images: Sequence[ImageKeypoints], landmarks: LandmarkMap, found: LandmarkMatches
) -> ObservedPoints:
    """Return the landmarks and keypoints of the matches ``found``, as input for a pose solver."""
    first = torch.tensor([0, *(len(image.keypoints) for image in images)]).cumsum(0)
    number = first[found.view] + found.keypoint
    T_camera_rig = SE3.stack([image.T_ref_camera.inverse() for image in images])
    return ObservedPoints(
        landmarks.positions[found.landmark].double(),
        landmarks.deviations[found.landmark].double(),
        landmarks.directions[found.landmark].double(),
        torch.cat([image.rays for image in images])[number, :2],
        torch.tensor([image.focal for image in images], dtype=torch.float64)[found.view],
        torch.cat([image.depth for image in images])[number],
        T_camera_rig.rotation[found.view],
        T_camera_rig.translation[found.view],
        torch.cat([image.exposure_times for image in images])[number],
    )
