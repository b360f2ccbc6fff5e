"""Positional encoding (Mildenhall et al. 2020, section 5.1)."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor


def encoded_width(frequencies: int, include_input: bool) -> int:
    """Return the length of a point's encoding."""
    return 3 * (2 * frequencies + include_input)


def positional_encoding(
    points: Float[Tensor, "p 3"], frequencies: int, include_input: bool = True
) -> Float[Tensor, "p f"]:
    """Return ``(p, sin(2^0 pi p), cos(2^0 pi p), ..., sin(2^(L-1) pi p), cos(2^(L-1) pi p))`` (eq. 4).

    Coordinates are in [-1, 1], one period of the lowest frequency. For each frequency, the three sines come before the
    three cosines. ``p`` itself comes first if ``include_input`` is set.
    """
    octaves = torch.arange(frequencies, dtype=points.dtype, device=points.device)
    angles = points[:, None, :] * (torch.pi * 2**octaves)[:, None]
    waves = torch.stack([angles.sin(), angles.cos()], dim=-2).flatten(1)
    return torch.cat([points, waves], dim=-1) if include_input else waves
