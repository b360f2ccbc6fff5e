"""The second pose of a planar scene: two poses may explain observations of nearly coplanar landmarks.

From a distance, a plane tilted to one side of the line of sight looks almost like one tilted to the other side. Both poses are
local minima of the reprojection error, so refinement stays at the one where it started (Schweighofer and Pinz 2006, "Robust pose
estimation from a planar target").
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.geometry.se3 import SE3
from bidnerf_core.mapping.geometry.calibration import FIXED, CalibrationPrior
from bidnerf_core.mapping.geometry.observations import ObservedPoints
from bidnerf_core.mapping.geometry.resection import ReprojectionFit, log_likelihood_ratio, resect

LEAST_POINTS = 4
"""Minimum number of points that determine a pose."""
FAR_OFF = 10.0
"""Median residual, in standard deviations, beyond which a second pose is discarded before refinement."""
SAME = 5.0
"""Squared Mahalanobis distance, in the first pose's covariance, below which two poses are the same minimum."""


@dataclass(frozen=True, eq=False)
class PlanarPose:
    """The other local minimum of the reprojection error."""

    fit: ReprojectionFit
    log_odds: float  # of the first pose against this one, given the observations


def second_pose(
    data: ObservedPoints,
    first: ReprojectionFit,
    correlation: float = 1.0,
    prior: CalibrationPrior = FIXED,
) -> PlanarPose | None:
    """Return the other local minimum for observations of a plane, or None if refinement leads back to the first.

    The points must be nearly coplanar and subtend a small angle. ``correlation`` is the number of observations that count as one.
    """
    start = start_of_second_pose(data, first.T_world_rig, first.noise)
    if start is None:
        return None
    fit = resect(data, start, first.noise, prior, first.calibration, correlation)
    shift = (first.T_world_rig.inverse() @ fit.T_world_rig).log()
    if float(shift @ torch.linalg.solve(first.covariance, shift)) < SAME:
        return None
    return PlanarPose(fit, log_likelihood_ratio(data, first, fit, correlation))


def start_of_second_pose(data: ObservedPoints, T_world_rig: SE3, noise: float) -> SE3 | None:
    """Return the start of the search for the other minimum, or None if the points are too far from coplanar or too close.

    ``noise`` is that of the keypoints, pixels.
    """
    if len(data) < LEAST_POINTS:
        return None
    start = tilted_to_the_other_side(data.points, T_world_rig)
    off = torch.linalg.vector_norm(data.normalized_residuals(start, noise), dim=-1)
    return start if float(off.median()) <= FAR_OFF else None


def tilted_to_the_other_side(points: Float[Tensor, "m 3"], T_world_camera: SE3) -> SE3:
    """Return the pose from which, to first order, the plane of the points (metres, world) looks the same.

    In the camera's frame, the points are reflected in the plane through their middle perpendicular to the line of sight. For
    coplanar points, which are their own mirror image in their plane, this is a rigid motion.
    """
    middle = points.mean(0)
    normal = torch.linalg.svd(points - middle, full_matrices=False).Vh[-1]
    T_camera_world = T_world_camera.inverse()
    seen = T_camera_world.apply(middle)
    rotation = _mirror(seen) @ T_camera_world.rotation @ _mirror(normal)
    return SE3(rotation, seen - rotation @ middle).inverse()


def _mirror(normal: Float[Tensor, "3"]) -> Float[Tensor, "3 3"]:
    """Return the reflection in the plane through the origin with a normal of any length."""
    unit = torch.nn.functional.normalize(normal, dim=0)
    return torch.eye(3, dtype=normal.dtype) - 2 * torch.outer(unit, unit)
