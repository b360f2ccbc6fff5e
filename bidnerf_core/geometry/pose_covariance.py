"""Covariances of poses in the conventions of other software.

Ours is that of ``se3``: a right update ``T exp(xi)`` with xi = (translation, rotation), both in the camera's own axes.
"""

from __future__ import annotations

from typing import Literal, get_args

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.errors import InputError
from bidnerf_core.geometry.se3 import SE3

CovarianceConvention = Literal["bidnerf", "gtsam", "ros"]
"""Order and frame of the rows of a covariance.

- ``"bidnerf"``: translation, then rotation, of a right update in the camera's axes (as Sophus has it).
- ``"gtsam"``: rotation, then translation, of a right update in the camera's axes: the tangent of GTSAM's ``Pose3``.
- ``"ros"``: ``geometry_msgs/PoseWithCovariance``: x, y, z, then the rotations about the fixed x, y and z axes of the world.
"""


def covariance_in(
    covariance: Float[Tensor, "6 6"], T_world_camera: SE3, convention: CovarianceConvention
) -> Float[Tensor, "6 6"]:
    """Convert one of our covariances at ``T_world_camera`` to another convention (float64).

    A right update by (rho, phi) moves the position by ``R rho`` in the world and premultiplies the rotation
    by ``exp(R phi)``, to first order, so both blocks are rotated for ROS. Raises ``InputError`` for an
    unknown convention.
    """
    if convention not in get_args(CovarianceConvention):
        raise InputError(
            f"convention is {convention!r}", expected=f"one of {', '.join(get_args(CovarianceConvention))}"
        )
    found = covariance.detach().cpu().double()
    if convention == "gtsam":
        return found.roll((3, 3), (0, 1))
    if convention == "ros":
        turn = torch.block_diag(*2 * [T_world_camera.rotation.detach().cpu().double()])
        return turn @ found @ turn.mT
    return found
