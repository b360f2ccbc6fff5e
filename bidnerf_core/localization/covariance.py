"""Covariances of poses, of right updates in the camera frame: translation (metres) before rotation (radians)."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.depth import UNKNOWN, DepthSensorModel
from bidnerf_core.geometry import SE3, USUAL
from bidnerf_core.localization.costs.surface import PointCloud, PointScales, SurfaceCost
from bidnerf_core.mapping import SurfaceMap

LEAST_VARIANCE = 1e-9
"""Lower limit of the variance of residuals, in units of their scale; smaller values are rounding errors."""
FINEST = 2.0
"""Scale of the distance residuals at the end of a search, in cells of the surface's grid."""


def weight(measurements: float, variance: float) -> float:
    """Return the weight of a mean squared residual in a sum of terms, from its number of independent measurements."""
    return measurements / max(variance, LEAST_VARIANCE)


def sandwich_covariance(
    scores: Float[Tensor, "h n 6"], hessian: Float[Tensor, "h 6 6"]
) -> Float[Tensor, "h 6 6"]:
    """Return ``H^-1 (sum_r s_r s_r^T) H^-1`` with the score ``s_r`` of each ray (Huber 1967).

    The noise of each kind of measurement is estimated from the residuals themselves, and the channels of one ray may be
    correlated. The covariance is infinite if the rays do not determine the pose.
    """
    scores = scores - scores.mean(1, keepdim=True)  # the remaining mean gradient is not noise
    used = int((scores != 0).any(-1).any(0).sum())
    if used <= 6:
        return torch.full_like(hessian, torch.inf)
    unit = hessian.diagonal(dim1=-2, dim2=-1).clamp(min=1e-300).rsqrt()
    scaled = unit[..., None] * hessian * unit[..., None, :]
    finite = (
        scaled.isfinite().all(-1).all(-1)
    )  # a field's gradients may overflow, and eigh would fail on them
    values, axes = torch.linalg.eigh(
        torch.where(finite[:, None, None], scaled, torch.eye(6, dtype=scaled.dtype, device=scaled.device))
    )
    inverse = axes @ torch.diag_embed(1 / values.clamp(min=1e-300)) @ axes.mT
    inverse = unit[..., None] * inverse * unit[..., None, :]
    found = inverse @ (scores.mT @ scores) @ inverse * (used / (used - 6))
    sound = finite & (values[..., 0] > 1e-10) & found.isfinite().all(-1).all(-1)
    return torch.where(sound[:, None, None], (found + found.mT) / 2, torch.inf)


def finest_cost(surface: SurfaceMap, cloud: PointCloud) -> SurfaceCost:
    """Return the cost of measured points at the finest distance scale that the surface's cells allow."""
    return SurfaceCost(surface, cloud, PointScales(FINEST * surface.cell))


def surface_covariance(
    cost: SurfaceCost,
    T: SE3,
    views: int = 1,
    sensor: DepthSensorModel = UNKNOWN,
    points: float = USUAL.points,
) -> Float[Tensor, "6 6"]:
    """Return the covariance of a pose that aligns measured points with the surface; positive definite.

    It is the inverse of the Hessian divided by the variance of the residuals, with the points of a view counting as ``points``
    independent ones. Along directions that the points do not determine, such as that of a bare wall, the standard deviation is
    the size of the scene or half a turn. The uncertainties of the sensor's scale and offset, which all points share, are added.
    """
    cost = finest_cost(cost.surface, cost.cloud)
    variance = cost.residual_variance(T[None])[0].clamp(min=LEAST_VARIANCE) / (points * views)
    prior = torch.tensor([cost.surface.extent] * 3 + [math.pi] * 3, dtype=torch.float64)
    information = cost(T[None]).hessian[0] / variance + torch.diag(prior**-2)
    covariance = torch.linalg.inv(information)
    for shared in (sensor.scale * scale_slope(cost.cloud), sensor.offset * offset_slope(cost.cloud)):
        covariance = covariance + shared[:, None] * shared
    found = cost.cloud.pivot.at_camera(T, covariance)
    return (found + found.mT) / 2


def scale_slope(cloud: PointCloud) -> Float[Tensor, "6"]:
    """Return the update about the cloud's pivot that compensates for depths larger by 100 %, metres."""
    return torch.cat([-cloud.middle.double().cpu(), torch.zeros(3, dtype=torch.float64)])


def offset_slope(cloud: PointCloud) -> Float[Tensor, "6"]:
    """Return the update about the cloud's pivot that compensates for an offset of distances, metres per metre."""
    sight = torch.nn.functional.normalize((cloud.points - cloud.origins).double(), dim=-1)
    return torch.cat([-sight.mean(0).cpu(), torch.zeros(3, dtype=torch.float64)])


def position_deviation(covariance: Float[Tensor, "6 6"]) -> float:
    """Return the standard deviation (metres) of the position along its least certain direction.

    It is infinite if the covariance is not finite.
    """
    if not bool(covariance.isfinite().all()):
        return math.inf
    return float(torch.linalg.eigvalsh(covariance[:3, :3])[-1].clamp(min=0).sqrt())
