"""Quaternions (w, x, y, z)."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor


def turned_back(quaternions: Float[Tensor, "*p 4"], vectors: Float[Tensor, "*p 3"]) -> Float[Tensor, "*p 3"]:
    """Rotate vectors by the inverses of unit quaternions."""
    w, axis = quaternions[..., :1], quaternions[..., 1:]
    twice = 2 * torch.linalg.cross(vectors, axis)
    return vectors + w * twice + torch.linalg.cross(twice, axis)


def matrices(quaternions: Float[Tensor, "*p 4"]) -> Float[Tensor, "*p 3 3"]:
    """Return the rotation matrices of unit quaternions."""
    w, x, y, z = quaternions.unbind(-1)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)


def product(a: Float[Tensor, "*p 4"], b: Float[Tensor, "*p 4"]) -> Float[Tensor, "*p 4"]:
    """Return the product: the rotation ``b`` followed by ``a``."""
    aw, av, bw, bv = a[..., :1], a[..., 1:], b[..., :1], b[..., 1:]
    w = aw * bw - (av * bv).sum(-1, keepdim=True)
    return torch.cat([w, aw * bv + bw * av + torch.linalg.cross(av, bv)], dim=-1)
