"""Poses about a pose."""

from __future__ import annotations

import torch
from torch.quasirandom import SobolEngine

from bidnerf_core.se3 import SE3


def neighbours(T: SE3, count: int, translation: float, rotation: float, seed: int) -> SE3:
    """``T`` and ``count`` - 1 more: right updates of it that are spread evenly under a normal distribution.

    ``translation`` (metres) and ``rotation`` (radians) are its standard deviations along and about each axis of the
    camera; even is in the sense of Sobol 1967, scrambled by ``seed``. Shape (count).
    """
    even = SobolEngine(6, scramble=True, seed=seed).draw(count, dtype=torch.float64)
    deviation = torch.tensor([translation] * 3 + [rotation] * 3, dtype=torch.float64)
    xi = deviation * torch.special.ndtri(even.clamp(1e-6, 1 - 1e-6))
    xi[0] = 0
    return SE3(T.rotation[None], T.translation[None]).retract(xi)
