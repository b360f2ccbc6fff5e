"""Real spherical harmonics up to degree 3, with the signs and order of the original 3DGS code (Kerbl et al. 2023)."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

C0 = 0.28209479177387814
C1 = 0.4886025119029199
C2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
C3 = (0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154, 1.445305721320277)


def basis(directions: Float[Tensor, "*p 3"], count: int) -> Float[Tensor, "*p k"]:
    """Return the first ``count`` (1, 4, 9 or 16) harmonics at unit directions."""
    x, y, z = directions.unbind(-1)
    found = [torch.full_like(x, C0)]
    if count > 1:
        found += [-C1 * y, C1 * z, -C1 * x]
    if count > 4:
        xx, yy, zz = x * x, y * y, z * z
        found += [
            C2[0] * x * y, -C2[0] * y * z, C2[1] * (2 * zz - xx - yy), -C2[0] * x * z, C2[2] * (xx - yy)
        ]  # fmt: skip
    if count > 9:
        found += [
            -C3[0] * y * (3 * xx - yy),
            C3[1] * x * y * z,
            -C3[2] * y * (4 * zz - xx - yy),
            C3[3] * z * (2 * zz - 3 * xx - 3 * yy),
            -C3[2] * x * (4 * zz - xx - yy),
            C3[4] * z * (xx - yy),
            -C3[0] * x * (xx - 3 * yy),
        ]
    return torch.stack(found, dim=-1)


def colours(harmonics: Float[Tensor, "*p k 3"], directions: Float[Tensor, "*p 3"]) -> Float[Tensor, "*p 3"]:
    """Evaluate the colours of harmonics along unit directions, in [0, 1]."""
    if harmonics.shape[-2] == 1:
        return (0.5 + C0 * harmonics[..., 0, :]).clamp(0, 1)
    weights = basis(directions, harmonics.shape[-2])
    return (0.5 + (weights[..., None] * harmonics).sum(-2)).clamp(0, 1)


def rotated(harmonics: Float[Tensor, "n k 3"], rotation: Float[Tensor, "3 3"]) -> Float[Tensor, "n k 3"]:
    """Rotate harmonics by ``rotation``: seen along ``R d``, they are what they were along ``d``.

    Each degree mixes within itself, by the matrix that relates the harmonics at some directions to those at
    the rotated ones.
    """
    count = harmonics.shape[1]
    generator = torch.Generator().manual_seed(0)
    directions = torch.nn.functional.normalize(
        torch.randn((8 * count, 3), generator=generator, dtype=torch.float64), dim=-1
    )
    before, after = basis(directions, count), basis(directions @ rotation.double().mT, count)
    mixing = torch.linalg.lstsq(after, before).solution  # after @ mixing = before
    return torch.einsum("jk,nkc->njc", mixing, harmonics.double()).to(harmonics)
