"""Observations of points: of known points by a rig of unknown pose, and of unknown points by posed cameras."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from bidnerf_core.camera import moved_points
from bidnerf_core.geometry import SE3
from bidnerf_core.mapping.geometry.calibration import Calibration
from bidnerf_core.mapping.geometry.projection import NEAREST, reprojection_errors


@dataclass(frozen=True, eq=False)
class ObservedPoints:
    """World points and their observations by the cameras of a rig. Float64."""

    points: Float[Tensor, "m 3"]  # metres, world
    deviations: Float[
        Tensor, "m 2"
    ]  # metres: standard deviations of the points across and along ``directions``
    directions: Float[Tensor, "m 3"]  # unit, world
    image: Float[Tensor, "m 2"]  # observed, on the plane z = 1 of the camera
    focal: Float[Tensor, "m"]  # pixels
    depth: Float[Tensor, "m"]  # metres, 0 where none was measured
    rotation: Float[Tensor, "m 3 3"]  # R_camera_rig
    translation: Float[Tensor, "m 3"]  # t_camera_rig, metres
    exposure_times: Float[Tensor, "m"]  # see the function ``exposure_times``

    def __len__(self) -> int:
        return len(self.points)

    def __getitem__(self, index: Tensor) -> ObservedPoints:
        return ObservedPoints(*(getattr(self, name)[index] for name in (f.name for f in fields(self))))

    def corrected(self, calibration: Calibration) -> ObservedPoints:
        """Return the observations with the cameras' calibration corrected."""
        undistorted = calibration.undistorted(self.image)
        return replace(self, image=undistorted, focal=self.focal * calibration.focal_factor)

    def without_motion(self, T_world_rig: SE3, motion: Float[Tensor, "6"]) -> ObservedPoints:
        """Return the points displaced so that a static camera at this pose observes them where the moving one did."""
        if not bool(motion.any()):
            return self
        rig = T_world_rig.inverse().apply(self.points)
        return replace(self, points=T_world_rig.apply(moved_points(rig, self.exposure_times, motion)))

    def in_camera(self, T_world_rig: SE3) -> Float[Tensor, "m 3"]:
        """Return each point in the frame of the camera that observed it."""
        rig = T_world_rig.inverse().apply(self.points)
        return (self.rotation @ rig[..., None])[..., 0] + self.translation

    def residuals(self, T_world_rig: SE3) -> Float[Tensor, "m 2"]:
        """Return projection minus observation, pixels; infinite for points behind the camera."""
        return reprojection_errors(self.in_camera(T_world_rig), self.image, self.focal)

    def normalized_residuals(self, T_world_rig: SE3, noise: float) -> Float[Tensor, "m 2"]:
        """Return the residuals in standard deviations, from the keypoints' ``noise`` (pixels) and the points' errors."""
        deviation = (noise**2 + self.point_variance(T_world_rig)).sqrt()
        return self.residuals(T_world_rig) / deviation[:, None]

    def point_variance(self, T_world_rig: SE3) -> Float[Tensor, "m"]:
        """Return the variance (square pixels) that the points' errors add to each residual, averaged over both axes.

        Along the axis perpendicular to both the line of sight and ``directions``, this is the point's variance across. Along the
        other axis it is a mixture of the variances across and along, by the squared cosine and sine of the angle between the
        line of sight and ``directions``.
        """
        local = self.in_camera(T_world_rig)
        centres = T_world_rig.apply(-(self.rotation.mT @ self.translation[..., None])[..., 0])
        sight = self.points - centres
        cosine = (sight * self.directions).sum(-1) / torch.linalg.vector_norm(sight, dim=-1).clamp(min=1e-12)
        across, along = self.deviations.square().unbind(-1)
        seen = cosine.square().clamp(max=1)
        metres = (across * (1 + seen) + along * (1 - seen)) / 2
        z = torch.where(local[:, 2] > NEAREST, local[:, 2], 1)
        return metres * (self.focal / z).square()


@dataclass(frozen=True, eq=False)
class Sightings:
    """Observations of points by images with known poses, both by number. Float64."""

    point: Int[Tensor, "m"]
    view: Int[Tensor, "m"]  # number of the image
    rotation: Float[Tensor, "m 3 3"]  # R_camera_world, when the observation's row was exposed
    centre: Float[Tensor, "m 3"]  # of the camera at that time, metres, world
    image: Float[Tensor, "m 2"]  # on the plane z = 1 of the camera
    focal: Float[Tensor, "m"]  # pixels; residuals are multiplied by it
    exposure_times: Float[Tensor, "m"]  # see the function ``exposure_times``

    def __getitem__(self, index: Tensor) -> Sightings:
        return Sightings(*(getattr(self, name)[index] for name in self.__dataclass_fields__))

    def __len__(self) -> int:
        return len(self.point)

    def directions(self) -> Float[Tensor, "m 3"]:
        """Return unit vectors (world) from the cameras towards the observed points."""
        ray = torch.cat([self.image, torch.ones_like(self.image[:, :1])], dim=-1)
        world = (self.rotation.mT @ ray[..., None])[..., 0]
        return world / torch.linalg.vector_norm(world, dim=-1, keepdim=True)

    def in_camera(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, "m 3"]:
        """Return the observed point of each observation in the frame of its camera."""
        return (self.rotation @ (points[self.point] - self.centre)[..., None])[..., 0]

    def residuals(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, "m 2"]:
        """Return projection minus observation, pixels; infinite for points behind the camera."""
        return reprojection_errors(self.in_camera(points), self.image, self.focal)


def summed(values: Tensor, index: Tensor, count: int) -> Tensor:
    """Return the sums of those ``values`` that belong to each of ``count`` points or views, by number."""
    return torch.zeros((count, *values.shape[1:]), dtype=values.dtype).index_add_(0, index, values)
