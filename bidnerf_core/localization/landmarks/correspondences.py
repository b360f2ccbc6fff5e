"""Correspondences between the keypoints of a rig's images and landmarks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from bidnerf_core.camera.intrinsics import Intrinsics
from bidnerf_core.camera.rolling_shutter import exposure_times, transposed_exposure_times
from bidnerf_core.frames.frame import Frame, View
from bidnerf_core.geometry.se3 import SE3
from bidnerf_core.mapping.geometry.observations import ObservedPoints
from bidnerf_core.mapping.landmarks.features import Features, Keypoints, detected, visible_keypoints
from bidnerf_core.mapping.landmarks.keypoint_depth import measured_depth
from bidnerf_core.mapping.landmarks.landmark_map import LandmarkMap

MIN_MATCHES = 6
"""Minimum number of correspondences from which a pose, or a scale of measured depth, is estimated."""
MAX_AMBIGUITY = 0.9
"""Maximum ratio of the descriptor distances of the best and the second-best candidate for a match (Lowe 2004, section 7.1)."""


@dataclass(frozen=True, eq=False)
class QueryImage:
    """The keypoints of a query image, as undistorted rays, and the pose of its camera in the rig's frame."""

    keypoints: Keypoints
    rays: Float[Tensor, "n 3"]  # on the plane z = 1 of the camera, float64
    depth: Float[Tensor, "n"]  # metres, 0 where none was measured
    intrinsics: Intrinsics
    T_rig_camera: SE3  # float64
    hidden: Bool[Tensor, "h w"] | None = None  # pixels of objects that are not in the map, see ``Frame``

    @property
    def focal(self) -> float:
        """The geometric mean of the two focal lengths, pixels."""
        return (self.intrinsics.fx * self.intrinsics.fy) ** 0.5


def query_images(views: Sequence[View], features: Features) -> list[QueryImage]:
    """Detect the keypoints of ``views``, with poses in any common frame; the rig's frame is that of the last camera."""
    T_rig_ref = views[-1].T_ref_camera.to("cpu", torch.float64).inverse()
    return [
        query_image(
            view.frame, (T_rig_ref @ view.T_ref_camera.to("cpu", torch.float64)).normalized(), features
        )
        for view in views
    ]


def query_image(frame: Frame, T_rig_camera: SE3, features: Features) -> QueryImage:
    hidden = None if frame.hidden is None else frame.hidden.cpu()
    keypoints = visible_keypoints(detected(features, frame.rgb), hidden)
    rays = frame.intrinsics.unproject(keypoints.pixels.double())
    depth = measured_depth(frame, keypoints.pixels)
    return QueryImage(keypoints, rays, depth, frame.intrinsics, T_rig_camera, hidden)


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
    images: Sequence[QueryImage], landmarks: LandmarkMap, found: LandmarkMatches
) -> ObservedPoints:
    """Return the landmarks and keypoints of the matches ``found``, as input for a pose solver."""
    first = torch.tensor([0, *(len(image.keypoints) for image in images)]).cumsum(0)
    number = first[found.view] + found.keypoint
    T_camera_rig = SE3.stack([image.T_rig_camera.inverse() for image in images])
    return ObservedPoints(
        landmarks.positions[found.landmark].double(),
        landmarks.deviations[found.landmark].double(),
        landmarks.directions[found.landmark].double(),
        torch.cat([image.rays for image in images])[number, :2],
        torch.tensor([image.focal for image in images], dtype=torch.float64)[found.view],
        torch.cat([image.depth for image in images])[number],
        T_camera_rig.rotation[found.view],
        T_camera_rig.translation[found.view],
        *(
            torch.cat([of(image.keypoints.pixels, image.intrinsics) for image in images])[number]
            for of in (exposure_times, transposed_exposure_times)
        ),
    )
