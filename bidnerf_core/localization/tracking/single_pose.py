"""Rigid transforms of single poses in NumPy and SciPy: the maps of ``SE3``, which are made for batches, take a millisecond each."""

from __future__ import annotations

import math

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation
from torch import Tensor

from bidnerf_core.se3 import SE3

SERIES_ANGLE = 1e-4
"""Angle (radians) under which the coefficients of the Jacobians come from their series."""


def retracted(T: SE3, tangent: Float[Tensor, "6"]) -> SE3:
    """Return the right update ``T @ exp(tangent)``, as ``SE3.retract`` does; float64, without derivatives."""
    step = tangent.numpy()
    rotation, translation = T.rotation.numpy(), T.translation.numpy()
    moved = translation + rotation @ (_left_jacobian(step[3:]) @ step[:3])
    turned = rotation @ Rotation.from_rotvec(step[3:]).as_matrix()
    return SE3(torch.from_numpy(turned), torch.from_numpy(moved))


def update_between(a: SE3, b: SE3) -> Float[Tensor, "6"]:
    """Return the right update that leads from ``a`` to ``b``: ``(a.inverse() @ b).log()``; float64, without derivatives."""
    back = a.rotation.numpy().T
    phi = Rotation.from_matrix(back @ b.rotation.numpy()).as_rotvec()
    rho = np.linalg.solve(_left_jacobian(phi), back @ (b.translation - a.translation).numpy())
    return torch.from_numpy(np.concatenate([rho, phi]))


def _left_jacobian(phi: np.ndarray) -> np.ndarray:
    """Return V(phi) of ``exp`` (Sola et al. 2018, eq. 145)."""
    angle = math.sqrt(float(phi @ phi))
    x, y, z = phi
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    if angle < SERIES_ANGLE:
        return np.eye(3) + cross / 2 + cross @ cross / 6
    b, c = (1 - math.cos(angle)) / angle**2, (angle - math.sin(angle)) / angle**3
    jacobian: np.ndarray = np.eye(3) + b * cross + c * (cross @ cross)
    return jacobian
