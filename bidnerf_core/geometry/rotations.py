"""Rotations and updates of single poses in NumPy, in microseconds per call.

``SE3`` and SciPy are built for batches and take about a millisecond per call.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation
from torch import Tensor

from bidnerf_core.geometry.se3 import SE3

SERIES_ANGLE = 1e-4
"""Angle (radians) below which coefficients are computed from their series."""


def cross_matrix(phi: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Return the matrix K with ``K @ v = cross(phi, v)``."""
    x, y, z = phi.tolist()
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def rotation_matrix(phi: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Return the rotation matrix of the rotation vector ``phi`` (radians), by Rodrigues' formula."""
    return cv2.Rodrigues(phi)[0]


def rotation_vector(rotation: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3"]:
    """Return the rotation vector (radians) of a rotation matrix, with an angle from 0 to pi."""
    skew = 0.5 * (rotation - rotation.T)
    axis = np.array([skew[2, 1], skew[0, 2], skew[1, 0]])
    sine, cosine = math.sqrt(float(axis @ axis)), 0.5 * (float(np.trace(rotation)) - 1)
    angle = math.atan2(sine, cosine)
    if angle > 2.5:  # beyond this angle, the skew part does not determine the axis well
        vector: np.ndarray = Rotation.from_matrix(rotation).as_rotvec()
        return vector
    return axis * (1 + angle**2 / 6 if angle < SERIES_ANGLE else angle / sine)


def left_jacobian(phi: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Return V(phi), which maps the translation of a tangent vector to that of its exponential (Sola et al. 2018, eq. 145)."""
    cross, angle = cross_matrix(phi), math.sqrt(float(phi @ phi))
    if angle < SERIES_ANGLE:
        return np.eye(3) + cross / 2 + cross @ cross / 6
    b, c = 2 * (math.sin(angle / 2) / angle) ** 2, (angle - math.sin(angle)) / angle**3
    return np.eye(3) + b * cross + c * cross @ cross


def retract(T: SE3, tangent: Float[Tensor, "6"]) -> SE3:
    """Return ``T @ exp(tangent)`` (metres, radians), as ``SE3.retract`` does; float64, without derivatives."""
    step = tangent.numpy()
    rotation, translation = T.rotation.numpy(), T.translation.numpy()
    moved = translation + rotation @ (left_jacobian(step[3:]) @ step[:3])
    return SE3(torch.from_numpy(rotation @ rotation_matrix(step[3:])), torch.from_numpy(moved))


def update_between(a: SE3, b: SE3) -> Float[Tensor, "6"]:
    """Return the right update ``(a.inverse() @ b).log()`` (metres, radians); float64, without derivatives."""
    back = a.rotation.numpy().T
    phi = rotation_vector(back @ b.rotation.numpy())
    rho = np.linalg.solve(left_jacobian(phi), back @ (b.translation - a.translation).numpy())
    return torch.from_numpy(np.concatenate([rho, phi]))
