"""Triangulation: estimate points and their covariance from the rays of posed cameras."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bidnerf_core.geometry import inlier_weight, mad_deviation
from bidnerf_core.mapping.geometry.observations import Sightings, summed
from bidnerf_core.mapping.resection.states import by_camera_point, pinhole


def intersected(sightings: Sightings, count: int) -> Float[Tensor, "n 3"]:
    """Return the point nearest to all rays of each of ``count`` points (metres, world), by linear least squares."""
    d = sightings.directions()
    across = torch.eye(3, dtype=d.dtype) - d[:, :, None] * d[:, None]
    matrix = summed(across, sightings.point, count)
    right = summed((across @ sightings.centre[..., None])[..., 0], sightings.point, count)
    return torch.linalg.solve(_damped(matrix), right)


def refined_points(
    sightings: Sightings, points: Float[Tensor, "n 3"], scale: float, steps: int = 8
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3 3"]]:
    """Minimize the reprojection errors under a Cauchy loss of ``scale`` pixels by ``steps`` Gauss-Newton iterations.

    From the linear solution, four or five suffice. Returns the points and their covariances for a noise of one pixel (the
    inverses of their normal matrices).
    """
    for _ in range(steps):
        matrix, gradient = _normal_equations(sightings, points, scale)
        points = points - torch.linalg.solve(_damped(matrix), gradient)
    matrix, _ = _normal_equations(sightings, points, scale)
    return points, torch.linalg.inv(_damped(matrix))


def _normal_equations(
    sightings: Sightings, points: Float[Tensor, "n 3"], scale: float
) -> tuple[Float[Tensor, "n 3 3"], Float[Tensor, "n 3"]]:
    flat, depth, front = pinhole(sightings.in_camera(points))
    off = (flat - sightings.image) * sightings.focal[:, None]
    weight = front * inlier_weight(off.square().sum(-1), scale)
    jacobian = by_camera_point(flat, depth / sightings.focal) @ sightings.rotation
    weighted = jacobian.mT * weight[:, None, None]
    matrix = summed(weighted @ jacobian, sightings.point, len(points))
    return matrix, summed((weighted @ off[..., None])[..., 0], sightings.point, len(points))


def parallax(sightings: Sightings, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
    """Return twice the largest angle (radians) between a point's rays and their mean; 0 for points without observations."""
    away = points[sightings.point] - sightings.centre
    d = away / torch.linalg.vector_norm(away, dim=-1, keepdim=True).clamp(min=1e-300)
    mean = summed(d, sightings.point, len(points))
    mean = mean / torch.linalg.vector_norm(mean, dim=-1, keepdim=True).clamp(min=1e-300)
    off = torch.linalg.vector_norm(torch.linalg.cross(d, mean[sightings.point]), dim=-1)
    largest = torch.zeros(len(points), dtype=d.dtype)
    return 2 * largest.scatter_reduce(0, sightings.point, off, "amax").clamp(max=1).asin()


def fitting(sightings: Sightings, points: Float[Tensor, "n 3"], tolerance: float) -> Bool[Tensor, "m"]:
    """Return a mask of the observations within ``tolerance`` pixels of the projection of their point."""
    return torch.linalg.vector_norm(sightings.residuals(points), dim=-1) <= tolerance


def noise(sightings: Sightings, points: Float[Tensor, "n 3"]) -> float:
    """Return a robust standard deviation of the observations along each axis (pixels), corrected for the fitted points."""
    if not len(sightings):
        return 1.0
    seen = torch.bincount(sightings.point, minlength=len(points))
    spare = (1 - 1.5 / seen[sightings.point]).clamp(min=0.25)  # (2 m - 3) / 2 m for m observations
    residual = sightings.residuals(points) / spare.sqrt()[:, None]
    return mad_deviation(residual)


def _damped(matrix: Float[Tensor, "n 3 3"]) -> Float[Tensor, "n 3 3"]:
    """Return matrices that are solvable for rays without parallax, too."""
    size = matrix.diagonal(dim1=-2, dim2=-1).mean(-1).clamp(min=1e-30)
    return matrix + 1e-6 * size[:, None, None] * torch.eye(3, dtype=matrix.dtype)
