"""Pairs of a keypoint and a landmark, in the cameras of a rig."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from bidnerf_core.camera import Intrinsics
from bidnerf_core.frames import Frame, View
from bidnerf_core.mapping.features import Features, Keypoints
from bidnerf_core.mapping.keypoint_depth import measured_depth
from bidnerf_core.mapping.landmarks import LandmarkMap
from bidnerf_core.se3 import SE3


@dataclass(frozen=True, eq=False)
class QueryImage:
    """Keypoints of an image that is to be localized, without its distortion; in the frame of the rig's last camera."""

    keypoints: Keypoints
    rays: Float[Tensor, "n 3"]  # on the plane z = 1 of the camera, float64
    depth: Float[Tensor, "n"]  # metres, 0 where none was measured
    intrinsics: Intrinsics
    T_rig_camera: SE3  # float64

    @property
    def focal(self) -> float:
        """Pixels: geometric mean of the two focal lengths."""
        return (self.intrinsics.fx * self.intrinsics.fy) ** 0.5


def query_images(views: Sequence[View], features: Features) -> list[QueryImage]:
    """Detect the keypoints of ``views``, whose poses are known in any common frame; the last one is the rig's frame."""
    T_rig_ref = views[-1].T_ref_camera.to("cpu", torch.float64).inverse()
    return [
        query_image(view.frame, (T_rig_ref @ view.T_ref_camera.to("cpu", torch.float64)).normalized(), features)
        for view in views
    ]


def query_image(frame: Frame, T_rig_camera: SE3, features: Features) -> QueryImage:
    keypoints = features(frame.rgb)
    rays = frame.intrinsics.unproject(keypoints.pixels.double())
    depth = measured_depth(frame, keypoints.pixels)
    return QueryImage(keypoints, rays, depth, frame.intrinsics, T_rig_camera)


@dataclass(frozen=True, eq=False)
class Correspondences:
    """Which keypoint of which view shows which landmark."""

    view: Int[Tensor, "m"]
    keypoint: Int[Tensor, "m"]
    landmark: Int[Tensor, "m"]
    ambiguity: Float[Tensor, "m"]  # 0: nothing else looks like it; 1: something else looks as much like it

    def __len__(self) -> int:
        return len(self.view)

    def __getitem__(self, index: Tensor) -> Correspondences:
        return Correspondences(self.view[index], self.keypoint[index], self.landmark[index], self.ambiguity[index])

    @staticmethod
    def cat(parts: Sequence[Correspondences]) -> Correspondences:
        names = ("view", "keypoint", "landmark", "ambiguity")
        return Correspondences(*(torch.cat([getattr(part, name) for part in parts]) for name in names))


@dataclass(frozen=True, eq=False)
class Measured:
    """Correspondences with the numbers that a pose is computed from. Float64."""

    points: Float[Tensor, "m 3"]  # metres, world
    deviations: Float[Tensor, "m 2"]  # metres, of the points, across and along ``directions``
    directions: Float[Tensor, "m 3"]  # unit, world
    image: Float[Tensor, "m 2"]  # observed, on the plane z = 1 of the camera
    focal: Float[Tensor, "m"]  # pixels
    depth: Float[Tensor, "m"]  # metres, 0 where none was measured
    rotation: Float[Tensor, "m 3 3"]  # R_camera_rig
    translation: Float[Tensor, "m 3"]  # t_camera_rig, metres

    def __len__(self) -> int:
        return len(self.points)

    def __getitem__(self, index: Tensor) -> Measured:
        return Measured(*(getattr(self, name)[index] for name in self.__dataclass_fields__))

    def in_camera(self, T_world_rig: SE3) -> Float[Tensor, "m 3"]:
        """The points in the frame of the camera that shows them."""
        rig = T_world_rig.inverse().apply(self.points)
        return (self.rotation @ rig[..., None])[..., 0] + self.translation

    def residuals(self, T_world_rig: SE3) -> Float[Tensor, "m 2"]:
        """Projection less observation, pixels; infinite for points behind the camera."""
        local = self.in_camera(T_world_rig)
        z = local[:, 2:]
        off = (local[:, :2] / torch.where(z > 0, z, 1) - self.image) * self.focal[:, None]
        return torch.where(z > 0, off, torch.inf)


def measured(
    images: Sequence[QueryImage], landmarks: LandmarkMap, found: Correspondences
) -> Measured:
    """Look up what the correspondences refer to."""
    first = torch.tensor([0, *(len(image.keypoints) for image in images)]).cumsum(0)
    number = first[found.view] + found.keypoint
    T_camera_rig = SE3.stack([image.T_rig_camera.inverse() for image in images])
    return Measured(
        landmarks.positions[found.landmark].double(),
        landmarks.deviations[found.landmark].double(),
        landmarks.directions[found.landmark].double(),
        torch.cat([image.rays for image in images])[number, :2],
        torch.tensor([image.focal for image in images], dtype=torch.float64)[found.view],
        torch.cat([image.depth for image in images])[number],
        T_camera_rig.rotation[found.view],
        T_camera_rig.translation[found.view],
    )
