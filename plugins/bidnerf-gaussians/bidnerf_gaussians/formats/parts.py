"""Functions shared by several formats."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace

import numpy as np
import torch
from torch.nn.functional import pad

from bidnerf_core.io import Allowance
from bidnerf_gaussians.gaussians import Gaussians

LARGEST_FILE = 16 * 2**30
"""Bytes."""


def take_gaussians(allowance: Allowance, count: int, harmonics: int) -> None:
    """Count the memory of ``count`` Gaussians with so many harmonics, in numbers of 32 bits and copies of them while they are read.

    Raises ``InputError`` if a file of this size may not hold as many.
    """
    allowance.take(12 * count * (11 + 3 * harmonics))


def gaussians_of(
    means: np.ndarray,
    log_scales: np.ndarray,
    quaternions: np.ndarray,
    logits: np.ndarray,
    harmonics: np.ndarray,
) -> Gaussians:
    """Build Gaussians from arrays, in single precision."""
    parts = (means, log_scales, quaternions, logits, harmonics)
    return Gaussians(*(torch.from_numpy(np.array(part, dtype=np.float32)) for part in parts))


def joined(parts: Sequence[Gaussians]) -> Gaussians:
    """Concatenate Gaussians, with harmonics up to the highest degree among them."""
    count = max(part.harmonics.shape[1] for part in parts)
    full = [replace(part, harmonics=pad(part.harmonics, (0, 0, 0, count - part.harmonics.shape[1]))) for part in parts]
    return Gaussians(*(torch.cat([getattr(part, of.name) for part in full]) for of in fields(Gaussians)))


def logit(opacity: np.ndarray) -> np.ndarray:
    """Return the logits of one-byte opacities, which may be 0 or 1."""
    inside = opacity.astype(np.float64).clip(1e-6, 1 - 1e-6)
    return np.log(inside / (1 - inside))


def smallest_three(largest: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return the quaternions (n 4) whose component ``largest`` (n) is not stored, in the order of the file.

    ``others`` (n 3) are the stored ones as fractions of sqrt(1/2), in [-1, 1].
    """
    others = others.astype(np.float32) * np.float32(np.sqrt(0.5))
    missing = np.sqrt(np.clip(1 - (others**2).sum(-1), 0, None))
    found = np.empty((len(others), 4), np.float32)
    for number in range(4):
        rows = largest == number
        found[rows] = np.insert(others[rows], number, missing[rows], axis=1)
    return found
