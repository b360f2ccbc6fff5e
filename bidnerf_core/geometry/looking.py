"""The pose of a camera that looks at a given point."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.errors import InputError
from bidnerf_core.geometry.se3 import SE3


def look_at(
    eye: Sequence[float] | Float[Tensor, "3"],
    target: Sequence[float] | Float[Tensor, "3"],
    up: Sequence[float] = (0.0, 0.0, 1.0),
) -> SE3:
    """Return ``T_world_camera`` (float64) of a camera at ``eye`` that looks at ``target``, with ``up``
    pointing upwards.
    """
    position = torch.as_tensor(eye, dtype=torch.float64)
    forward = torch.as_tensor(target, dtype=torch.float64) - position
    if not torch.linalg.vector_norm(forward) > 0:
        raise InputError(f"the camera position {position.tolist()} equals its target", where="look_at")
    forward = torch.nn.functional.normalize(forward, dim=0)
    right = torch.linalg.cross(forward, torch.as_tensor(up, dtype=torch.float64))
    if torch.linalg.vector_norm(right) < 1e-6:  # straight up or down: any right will do
        right = torch.linalg.cross(forward, forward.new_tensor([0.0, 1.0, 0.0]))
    right = torch.nn.functional.normalize(right, dim=0)
    return SE3(torch.stack([right, torch.linalg.cross(forward, right), forward], dim=-1), position)
