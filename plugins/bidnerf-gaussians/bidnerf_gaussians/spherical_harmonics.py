"""Real spherical harmonics up to degree 3, with the signs and order of the original 3DGS code (Kerbl et al. 2023)."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.devices import constant
from bidnerf_core.fields import spherical_harmonics

C0 = 0.28209479177387814
SIGNS = (1.0, -1.0) * 8


def basis(directions: Float[Tensor, "*p 3"], count: int) -> Float[Tensor, "*p k"]:
    """Return the first ``count`` (1, 4, 9 or 16) harmonics at unit directions, with the Condon-Shortley phase."""
    return spherical_harmonics(directions, count) * constant(SIGNS[:count], directions)


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
