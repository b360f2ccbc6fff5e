"""Poses and covariances as ROS has them; pure functions, which need no ROS.

bidnerf's camera axes are x right, y down, z forward: those of an *optical* frame (REP 103, "suffix frames"). Bodies have x forward, y
left, z up. A covariance of bidnerf is that of a right update at the camera, translation before rotation, in the camera's axes;
``geometry_msgs/PoseWithCovariance`` has (x, y, z, rotation about X, about Y, about Z) about *fixed* axes, those of the frame in the
header.
"""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core import SE3

R_BODY_OPTICAL = torch.tensor([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]], dtype=torch.float64)
"""REP 103: an optical frame's z is forward, its x is right, its y is down."""


def body_pose(T_world_camera: SE3) -> SE3:
    """Return the pose of a camera's body (x forward, y left, z up), at the same place as its optical frame."""
    return SE3(T_world_camera.rotation.double() @ R_BODY_OPTICAL.mT, T_world_camera.translation.double())


def quaternion(rotation: Float[Tensor, "3 3"]) -> tuple[float, float, float, float]:
    """Return the unit quaternion (x, y, z, w) of a rotation, with w >= 0 (Shepperd 1978).

    Of the four ways to compute it, the one is taken that divides by the largest number.
    """
    r = rotation.double().tolist()
    trace = r[0][0] + r[1][1] + r[2][2]
    squared = [1 + 2 * r[i][i] - trace for i in range(3)] + [1 + trace]
    best = max(range(4), key=lambda i: squared[i])
    value = [0.0] * 4
    if best == 3:
        value = [r[2][1] - r[1][2], r[0][2] - r[2][0], r[1][0] - r[0][1], squared[3]]
    else:
        i, j, k = best, (best + 1) % 3, (best + 2) % 3
        value[i], value[j], value[k] = squared[best], r[j][i] + r[i][j], r[k][i] + r[i][k]
        value[3] = r[k][j] - r[j][k]
    length = sum(part * part for part in value) ** 0.5
    x, y, z, w = (part / (length if value[3] >= 0 else -length) for part in value)
    return x, y, z, w


def rotation(x: float, y: float, z: float, w: float) -> Float[Tensor, "3 3"]:
    """Return the rotation of a quaternion of any length but 0."""
    n = x * x + y * y + z * z + w * w
    if not 0 < n < float("inf"):
        raise ValueError(f"quaternion ({x}, {y}, {z}, {w}), expected a finite one that is not 0")
    s = 2 / n
    rows = [
        [1 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w)],
        [s * (x * y + z * w), 1 - s * (x * x + z * z), s * (y * z - x * w)],
        [s * (x * z - y * w), s * (y * z + x * w), 1 - s * (x * x + y * y)],
    ]
    return torch.tensor(rows, dtype=torch.float64)


def fixed_axes_covariance(T_world_camera: SE3, covariance: Float[Tensor, "6 6"]) -> Float[Tensor, "6 6"]:
    """Return the covariance of a pose about the axes of the world, in the order of ROS.

    With ``T exp(rho, phi)``, the position moves by ``R rho`` and the rotation about fixed axes is ``R phi``, to first order.
    """
    turn = torch.block_diag(*[T_world_camera.rotation.double()] * 2)
    return turn @ covariance.double() @ turn.mT


def covariance_elsewhere(covariance: Float[Tensor, "6 6"], T_camera_base: SE3) -> Float[Tensor, "6 6"]:
    """Return the covariance of a right update at another frame that is rigidly fixed to the camera.

    ``T_world_camera exp(xi) T_camera_base = T_world_base exp(Ad(T_base_camera) xi)`` (Sola et al. 2018, eq. 33).
    """
    adjoint = T_camera_base.to("cpu", torch.float64).inverse().adjoint()
    return adjoint @ covariance.double() @ adjoint.mT


def transform_of(message: Any) -> SE3:
    """Return the rigid transform in a ``geometry_msgs/Transform`` or ``Pose``."""
    place = message.translation if hasattr(message, "translation") else message.position
    turn = message.rotation if hasattr(message, "rotation") else message.orientation
    return SE3(
        rotation(turn.x, turn.y, turn.z, turn.w),
        torch.tensor([place.x, place.y, place.z], dtype=torch.float64),
    )


def fill(message: Any, T: SE3) -> None:
    """Write a rigid transform into a ``geometry_msgs/Transform`` or ``Pose``."""
    place = message.translation if hasattr(message, "translation") else message.position
    turn = message.rotation if hasattr(message, "rotation") else message.orientation
    place.x, place.y, place.z = T.translation.tolist()
    turn.x, turn.y, turn.z, turn.w = quaternion(T.rotation)


def seconds(stamp: Any) -> float:
    """Return a ``builtin_interfaces/Time`` in seconds."""
    return float(stamp.sec) + 1e-9 * float(stamp.nanosec)
