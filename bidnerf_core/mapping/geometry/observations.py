"""Observations of points by posed cameras."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from bidnerf_core.mapping.resection.states import pinhole


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
        flat, _, front = pinhole(self.in_camera(points))
        return torch.where(front[:, None], (flat - self.image) * self.focal[:, None], torch.inf)


def summed(values: Tensor, index: Tensor, count: int) -> Tensor:
    """Return the sums of those ``values`` that belong to each of ``count`` points or views, by number."""
    return torch.zeros((count, *values.shape[1:]), dtype=values.dtype).index_add_(0, index, values)
