"""How certain a pose is: covariances of a right update at the camera, translation (metres) before rotation (radians)."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.localization.costs.surface import PointScales, SurfaceCost
from bidnerf_core.se3 import SE3

INDEPENDENT = 10
"""Independent measurements in an image. Errors of a map and of a sensor are alike over large parts of an image, so that its
thousands of pixels count for few; set by the normalised errors on several maps and sensors: rendered images are more certain
than this, those of a hand-held Kinect less.
"""
LEAST_VARIANCE = 1e-9
"""Variance of a residual, in units of its scale, below which there is only rounding."""
FINEST = 2.0
"""Scale of distances at the end of a search, in cells of the surface's grid."""


def sandwich_covariance(
    scores: Float[Tensor, "h n 6"], hessian: Float[Tensor, "h 6 6"]
) -> Float[Tensor, "h 6 6"]:
    """Return ``H^-1 (sum_r s_r s_r^T) H^-1`` with the score ``s_r`` of each ray (Huber 1967).

    The residuals themselves tell how noisy each kind of measurement is, and the channels of one ray may err together.
    Infinite where the rays do not determine the pose.
    """
    scores = scores - scores.mean(1, keepdim=True)  # the slope that is left is not noise
    used = int((scores != 0).any(-1).any(0).sum())
    if used <= 6:
        return torch.full_like(hessian, torch.inf)
    unit = hessian.diagonal(dim1=-2, dim2=-1).clamp(min=1e-300).rsqrt()
    scaled = unit[..., None] * hessian * unit[..., None, :]
    values, axes = torch.linalg.eigh(scaled)
    inverse = axes @ torch.diag_embed(1 / values.clamp(min=1e-300)) @ axes.mT
    inverse = unit[..., None] * inverse * unit[..., None, :]
    found = inverse @ (scores.mT @ scores) @ inverse * (used / (used - 6))
    sound = (values[..., 0] > 1e-10) & found.isfinite().all(-1).all(-1)
    return torch.where(sound[:, None, None], (found + found.mT) / 2, torch.inf)


def surface_covariance(cost: SurfaceCost, T: SE3, views: int = 1) -> Float[Tensor, "6 6"]:
    """Return the covariance of a pose that aligns measured points with the surface; positive definite.

    It is the inverse of the normal equations over the variance of the residuals. What the points do not determine, such as
    the way along a bare wall, has the size of the scene and half a turn.
    """
    finest = PointScales(FINEST * cost.surface.cell)
    cost = SurfaceCost(cost.surface, cost.cloud, finest)
    variance = cost.residual_variance(T[None])[0].clamp(min=LEAST_VARIANCE) / (INDEPENDENT * views)
    prior = torch.tensor([cost.surface.extent] * 3 + [math.pi] * 3, dtype=torch.float64)
    information = cost(T[None]).hessian[0] / variance + torch.diag(prior**-2)
    found = cost.cloud.pivot.at_camera(T, torch.linalg.inv(information))
    return (found + found.mT) / 2
