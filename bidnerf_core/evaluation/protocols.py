"""Where a localizer is started from: wrong by a known amount, reproducible from a seed alone."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Generator, Tensor

from bidnerf_core.errors import InputError
from bidnerf_core.se3 import SE3

SMALLEST, LARGEST = 0.5, 3.4
"""Translation lengths of the paper's tables: scene units in which the object fills a 2x2x2 cube, metres in rooms."""


def bid(T_true: SE3, size: float, seed: int) -> SE3:
    """BID-NeRF's: ``T_true exp((e_t u1, e_r u2))`` with random unit u1, u2 and e_t = ``size``.

    The paper does not say which e_r goes with which e_t, but that errors stay under 45 degrees: here e_r grows linearly
    from 0.2 rad at e_t = 0.5 to pi/4 at 3.4.
    """
    return _bid(T_true, size, math.pi / 4, seed)


def bid_hard(T_true: SE3, size: float, seed: int) -> SE3:
    """The same with e_r up to 1.4 rad, the upper end of the range that the paper prints."""
    return _bid(T_true, size, 1.4, seed)


def perturb(T_true: SE3, translation: float, rotation_deg: float, seed: int) -> SE3:
    """A start whose error is exactly ``translation`` (metres) and ``rotation_deg``, in random directions."""
    for what, value in (("translation", translation), ("rotation", rotation_deg)):
        _require_length(what, value)
    u1, u2 = random_units(2, torch.Generator().manual_seed(seed))
    turn = SE3.exp(torch.cat([torch.zeros_like(u2), math.radians(rotation_deg) * u2])).rotation
    return T_true.to(dtype=torch.float64) @ SE3(turn, translation * u1)


def rotation_of_size(size: float, widest: float = math.pi / 4) -> float:
    """e_r (rad) that goes with e_t = ``size``: on the line from (0.5, 0.2) to (3.4, ``widest``)."""
    return 0.2 + (size - SMALLEST) / (LARGEST - SMALLEST) * (widest - 0.2)


def random_units(count: int, generator: Generator) -> Float[Tensor, "n 3"]:
    """Directions, uniform on the sphere (float64)."""
    normal = torch.randn((count, 3), generator=generator, dtype=torch.float64)
    return torch.nn.functional.normalize(normal, dim=-1)


def _bid(T_true: SE3, size: float, widest: float, seed: int) -> SE3:
    _require_length("size", size)
    u1, u2 = random_units(2, torch.Generator().manual_seed(seed))
    return T_true.to(dtype=torch.float64).retract(
        torch.cat([size * u1, max(0.0, rotation_of_size(size, widest)) * u2])
    )


def _require_length(what: str, value: float) -> None:
    if not (math.isfinite(value) and value >= 0):
        raise InputError(f"perturbation: {what} is {value}, expected a finite number, 0 or more")
