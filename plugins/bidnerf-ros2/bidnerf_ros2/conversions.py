"""Poses and covariances in ROS conventions; pure functions that need no ROS.

bidnerf's camera axes are x right, y down, z forward: those of an *optical* frame (REP 103, "suffix frames").
Bodies have x forward, y left, z up. A bidnerf covariance is that of a right update at the camera, translation
before rotation, in the camera's axes; ``geometry_msgs/PoseWithCovariance`` has (x, y, z, rotation about X,
about Y, about Z) about *fixed* axes, those of the frame in the header.
"""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.geometry import SE3

R_BODY_OPTICAL = torch.tensor([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]], dtype=torch.float64)
"""REP 103: an optical frame's z is forward, its x is right, its y is down."""


def body_pose(T_world_camera: SE3) -> SE3:
    """Return the pose of a camera's body (x forward, y left, z up), at the same place as its optical frame."""
    return SE3(T_world_camera.rotation.double() @ R_BODY_OPTICAL.mT, T_world_camera.translation.double())


def covariance_elsewhere(covariance: Float[Tensor, "6 6"], T_camera_base: SE3) -> Float[Tensor, "6 6"]:
    """Return the covariance of a right update at another frame that is rigidly fixed to the camera.

    ``T_world_camera exp(xi) T_camera_base = T_world_base exp(Ad(T_base_camera) xi)`` (Sola et al. 2018, eq. 33).
    """
    adjoint = T_camera_base.to("cpu", torch.float64).inverse().adjoint()
    return adjoint @ covariance.double() @ adjoint.mT


def transform_of(message: Any) -> SE3:
    """Convert a ``geometry_msgs/Transform`` or ``Pose`` to a rigid transform. Raises ``InputError`` if its
    rotation is invalid.
    """
    place = message.translation if hasattr(message, "translation") else message.position
    turn = message.rotation if hasattr(message, "rotation") else message.orientation
    t = torch.tensor([place.x, place.y, place.z], dtype=torch.float64)
    q = torch.tensor([turn.x, turn.y, turn.z, turn.w], dtype=torch.float64)
    return SE3.from_quaternion(q, t, "xyzw")


def fill(message: Any, T: SE3) -> None:
    """Write a rigid transform into a ``geometry_msgs/Transform`` or ``Pose``."""
    place = message.translation if hasattr(message, "translation") else message.position
    turn = message.rotation if hasattr(message, "rotation") else message.orientation
    place.x, place.y, place.z = T.translation.tolist()
    turn.x, turn.y, turn.z, turn.w = T.to("cpu", torch.float64).quaternion("xyzw").tolist()


def seconds(stamp: Any) -> float:
    """Return a ``builtin_interfaces/Time`` in seconds."""
    return float(stamp.sec) + 1e-9 * float(stamp.nanosec)
