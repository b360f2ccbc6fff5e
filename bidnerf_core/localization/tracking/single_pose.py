"""Updates of single poses in NumPy: the maps of ``SE3``, which are made for batches, take a millisecond each."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.geometry.rotations import left_jacobian, rotation_matrix, rotation_vector
from bidnerf_core.geometry.se3 import SE3


def retracted(T: SE3, tangent: Float[Tensor, "6"]) -> SE3:
    """Return the right update ``T @ exp(tangent)``, as ``SE3.retract`` does; float64, without derivatives."""
    step = tangent.numpy()
    rotation, translation = T.rotation.numpy(), T.translation.numpy()
    moved = translation + rotation @ (left_jacobian(step[3:]) @ step[:3])
    return SE3(torch.from_numpy(rotation @ rotation_matrix(step[3:])), torch.from_numpy(moved))


def update_between(a: SE3, b: SE3) -> Float[Tensor, "6"]:
    """Return the right update that leads from ``a`` to ``b``: ``(a.inverse() @ b).log()``; float64, without derivatives."""
    back = a.rotation.numpy().T
    phi = rotation_vector(back @ b.rotation.numpy())
    rho = np.linalg.solve(left_jacobian(phi), back @ (b.translation - a.translation).numpy())
    return torch.from_numpy(np.concatenate([rho, phi]))
