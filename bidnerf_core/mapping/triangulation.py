"""Triangulation: points from the rays of posed cameras that see them, with their covariance."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

TRIANGULATION_STEPS = 8
"""Gauss-Newton steps; from the linear answer, four or five are enough."""
DAMPING = 1e-6
"""Of the mean diagonal: holds what rays without parallax leave open."""


@dataclass(frozen=True, eq=False)
class Sightings:
    """Observations of points: which point, from where, in which direction. Float64, world frame unless said."""

    point: Int[Tensor, "m"]
    rotation: Float[Tensor, "m 3 3"]  # R_camera_world
    centre: Float[Tensor, "m 3"]
    image: Float[Tensor, "m 2"]  # on the plane z = 1 of the camera
    focal: Float[Tensor, "m"]  # pixels; residuals are multiplied by it

    def __getitem__(self, index: Tensor) -> Sightings:
        return Sightings(*(getattr(self, name)[index] for name in self.__dataclass_fields__))

    def __len__(self) -> int:
        return len(self.point)

    def directions(self) -> Float[Tensor, "m 3"]:
        """Unit vectors from the camera towards what was seen."""
        ray = torch.cat([self.image, torch.ones_like(self.image[:, :1])], dim=-1)
        world = (self.rotation.mT @ ray[..., None])[..., 0]
        return world / torch.linalg.vector_norm(world, dim=-1, keepdim=True)

    def in_camera(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, "m 3"]:
        """The points that were seen, each in the frame of the camera that saw it."""
        return (self.rotation @ (points[self.point] - self.centre)[..., None])[..., 0]

    def residuals(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, "m 2"]:
        """Projection less observation, pixels; infinite behind the camera."""
        local = self.in_camera(points)
        z = local[:, 2:]
        off = local[:, :2] / torch.where(z > 0, z, 1) - self.image
        return torch.where(z > 0, off * self.focal[:, None], torch.inf)


def intersected(sightings: Sightings, count: int) -> Float[Tensor, "n 3"]:
    """The point nearest to all rays of each of ``count`` points, by linear least squares."""
    d = sightings.directions()
    across = torch.eye(3, dtype=d.dtype) - d[:, :, None] * d[:, None]
    matrix = _summed(across, sightings.point, count)
    right = _summed((across @ sightings.centre[..., None])[..., 0], sightings.point, count)
    return torch.linalg.solve(_held(matrix), right)


def refined(
    sightings: Sightings, points: Float[Tensor, "n 3"], scale: float
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3 3"]]:
    """Minimize the robust reprojection errors; Cauchy's loss of ``scale`` pixels.

    Returns the points and the inverse of their normal matrices: the covariance for a noise of one pixel.
    """
    for _ in range(TRIANGULATION_STEPS):
        matrix, gradient = _normal_equations(sightings, points, scale)
        points = points - torch.linalg.solve(_held(matrix), gradient)
    matrix, _ = _normal_equations(sightings, points, scale)
    return points, torch.linalg.inv(_held(matrix))


def _normal_equations(
    sightings: Sightings, points: Float[Tensor, "n 3"], scale: float
) -> tuple[Float[Tensor, "n 3 3"], Float[Tensor, "n 3"]]:
    local = sightings.in_camera(points)
    front = local[:, 2] > 0
    z = torch.where(front, local[:, 2], 1)
    residual = torch.where(front[:, None], sightings.residuals(points), 0)
    weight = front / (1 + residual.square().sum(-1) / scale**2)
    x, y, zero = local[:, 0] / z, local[:, 1] / z, torch.zeros_like(z)
    inverse = sightings.focal / z
    rows = torch.stack([inverse, zero, -x * inverse, zero, inverse, -y * inverse], dim=-1).unflatten(
        -1, (2, 3)
    )
    jacobian = rows @ sightings.rotation
    weighted = jacobian.mT * weight[:, None, None]
    matrix = _summed(weighted @ jacobian, sightings.point, len(points))
    return matrix, _summed((weighted @ residual[..., None])[..., 0], sightings.point, len(points))


def parallax(sightings: Sightings, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
    """Radians: the greatest angle of a ray to the mean ray of its point, twice; 0 for points that nothing sees."""
    away = points[sightings.point] - sightings.centre
    d = away / torch.linalg.vector_norm(away, dim=-1, keepdim=True).clamp(min=1e-300)
    mean = _summed(d, sightings.point, len(points))
    mean = mean / torch.linalg.vector_norm(mean, dim=-1, keepdim=True).clamp(min=1e-300)
    off = torch.linalg.vector_norm(torch.linalg.cross(d, mean[sightings.point]), dim=-1)
    largest = torch.zeros(len(points), dtype=d.dtype)
    return 2 * largest.scatter_reduce(0, sightings.point, off, "amax").clamp(max=1).asin()


def observations_per_point(sightings: Sightings, count: int) -> Int[Tensor, "n"]:
    return torch.bincount(sightings.point, minlength=count)


def fitting(sightings: Sightings, points: Float[Tensor, "n 3"], tolerance: float) -> Bool[Tensor, "m"]:
    """Return which observations lie within ``tolerance`` pixels of the projection of their point."""
    return torch.linalg.vector_norm(sightings.residuals(points), dim=-1) <= tolerance


def noise(sightings: Sightings, points: Float[Tensor, "n 3"]) -> float:
    """Standard deviation of an observation along each axis (pixels), robustly, with the points' own freedom allowed for."""
    if not len(sightings):
        return 1.0
    seen = observations_per_point(sightings, len(points))
    spare = (1 - 1.5 / seen[sightings.point]).clamp(min=0.25)  # (2 m - 3) / 2 m for m observations
    residual = sightings.residuals(points) / spare.sqrt()[:, None]
    return 1.4826 * float(residual.abs().median())


def _held(matrix: Float[Tensor, "n 3 3"]) -> Float[Tensor, "n 3 3"]:
    size = matrix.diagonal(dim1=-2, dim2=-1).mean(-1).clamp(min=1e-30)
    return matrix + DAMPING * size[:, None, None] * torch.eye(3, dtype=matrix.dtype)


def _summed(values: Tensor, index: Tensor, count: int) -> Tensor:
    return torch.zeros((count, *values.shape[1:]), dtype=values.dtype).index_add_(0, index, values)
