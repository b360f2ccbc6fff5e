"""Observations of points by posed cameras, and triangulation: the points and their covariance from the rays."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from bidnerf_core.devices import TensorRows
from bidnerf_core.geometry import inlier_weight, mad_deviation
from bidnerf_core.mapping.resection.states import by_camera_point, pinhole


@dataclass(frozen=True, eq=False)
class Sightings(TensorRows):
    """Observations of points in images with known poses; points and images are identified by number. Float64."""

    point: Int[Tensor, "m"]
    view: Int[Tensor, "m"]  # number of the image
    rotation: Float[Tensor, "m 3 3"]  # R_camera_world, when the observation's row was exposed
    centre: Float[Tensor, "m 3"]  # of the camera at that time, metres, world
    image: Float[Tensor, "m 2"]  # on the plane z = 1 of the camera
    focal: Float[Tensor, "m"]  # pixels; residuals are multiplied by it
    exposure_times: Float[Tensor, "m"]  # see the function ``exposure_times``

    def directions(self) -> Float[Tensor, "m 3"]:
        """Return unit vectors (world) from the cameras towards the observed points."""
        ray = torch.cat([self.image, torch.ones_like(self.image[:, :1])], dim=-1)
        return normalize((self.rotation.mT @ ray[..., None])[..., 0], dim=-1)

    def in_camera(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, "m 3"]:
        """Transform each observation's point to the frame of the camera that observes it."""
        return (self.rotation @ (points[self.point] - self.centre)[..., None])[..., 0]

    def residuals(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, "m 2"]:
        """Return projection minus observation, pixels; infinite for points behind the camera."""
        flat, _, front = pinhole(self.in_camera(points))
        return torch.where(front[:, None], (flat - self.image) * self.focal[:, None], torch.inf)


def sum_by(values: Tensor, index: Tensor, count: int) -> Tensor:
    """Sum the ``values`` of each of ``count`` points or views; ``index`` holds the number of each value's point or view."""
    return torch.zeros((count, *values.shape[1:]), dtype=values.dtype).index_add_(0, index, values)


AT_ONCE = 2**16
"""Number of observations whose matrices are computed at a time, which bounds the memory."""


def triangulate(sightings: Sightings, count: int) -> Float[Tensor, "n 3"]:
    """Triangulate ``count`` points: return the position (metres, world) nearest to all rays of each, by linear least squares."""
    matrix, right = (torch.zeros((count, 3, *more), dtype=torch.float64) for more in ((3,), ()))
    for first in range(0, len(sightings), AT_ONCE):
        some = sightings[first : first + AT_ONCE]
        d = some.directions()
        across = torch.eye(3, dtype=d.dtype) - d[:, :, None] * d[:, None]
        matrix.index_add_(0, some.point, across)
        right.index_add_(0, some.point, (across @ some.centre[..., None])[..., 0])
    return torch.linalg.solve(damp(matrix), right)


def refine_points(
    sightings: Sightings, points: Float[Tensor, "n 3"], scale: float, steps: int = 8
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3 3"]]:
    """Minimize the reprojection errors under a Cauchy loss of ``scale`` pixels by ``steps`` Gauss-Newton iterations.

    Four or five iterations suffice from the linear solution. Returns the points and their covariances for a noise of one pixel (the
    inverses of their normal matrices).
    """
    for _ in range(steps):
        matrix, gradient = _normal_equations(sightings, points, scale)
        points = points - torch.linalg.solve(damp(matrix), gradient)
    matrix, _ = _normal_equations(sightings, points, scale)
    return points, torch.linalg.inv(damp(matrix))


def _normal_equations(
    sightings: Sightings, points: Float[Tensor, "n 3"], scale: float
) -> tuple[Float[Tensor, "n 3 3"], Float[Tensor, "n 3"]]:
    matrix, gradient = (torch.zeros((len(points), 3, *more), dtype=torch.float64) for more in ((3,), ()))
    for first in range(0, len(sightings), AT_ONCE):
        some = sightings[first : first + AT_ONCE]
        flat, depth, front = pinhole(some.in_camera(points))
        residual = (flat - some.image) * some.focal[:, None]
        weight = front * inlier_weight(residual.square().sum(-1), scale)
        jacobian = by_camera_point(flat, depth / some.focal) @ some.rotation
        weighted = jacobian.mT * weight[:, None, None]
        matrix.index_add_(0, some.point, weighted @ jacobian)
        gradient.index_add_(0, some.point, (weighted @ residual[..., None])[..., 0])
    return matrix, gradient


def parallax(sightings: Sightings, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
    """Return twice the largest angle (radians) between a point's rays and their mean; 0 for points without observations."""
    towards = normalize(points[sightings.point] - sightings.centre, dim=-1, eps=1e-300)
    return 2 * viewing_cones(towards, sightings.point, len(points))[1]


def viewing_cones(
    directions: Float[Tensor, "m 3"], point: Int[Tensor, "m"], count: int
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n"]]:
    """Return the mean of each point's ``directions`` (unit), and the largest angle (radians) between it and one of them."""
    mean = normalize(sum_by(directions, point, count), dim=-1, eps=1e-300)
    cosine = (directions * mean[point]).sum(-1).clamp(-1, 1)
    least = torch.ones(count, dtype=cosine.dtype).scatter_reduce(0, point, cosine, "amin")
    return mean, least.acos()


def fits_points(sightings: Sightings, points: Float[Tensor, "n 3"], tolerance: float) -> Bool[Tensor, "m"]:
    """Return a mask of the observations within ``tolerance`` pixels of the projection of their point."""
    return torch.linalg.vector_norm(sightings.residuals(points), dim=-1) <= tolerance


def noise(sightings: Sightings, points: Float[Tensor, "n 3"]) -> float:
    """Return a robust standard deviation (pixels, per axis) of the observations, corrected for the points' degrees of freedom."""
    if not len(sightings):
        return 1.0
    seen = torch.bincount(sightings.point, minlength=len(points))
    spare = (1 - 1.5 / seen[sightings.point]).clamp(min=0.25)  # (2 m - 3) / 2 m for m observations
    return mad_deviation(sightings.residuals(points) / spare.sqrt()[:, None])


def damp(blocks: Float[Tensor, "b k k"], damping: float = 0.0, least: float = 1e-6) -> Float[Tensor, "b k k"]:
    """Return the blocks with their diagonals enlarged, so that even those of points without parallax are invertible.

    ``damping`` is relative to each entry of a diagonal, and ``least`` to its mean.
    """
    diagonal = blocks.diagonal(dim1=-2, dim2=-1)
    return blocks + torch.diag_embed(damping * diagonal + least * diagonal.mean(-1, keepdim=True).clamp(min=1e-30))
