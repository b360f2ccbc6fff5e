"""Levels of a hash encoding: their sizes, and the table indices of the vertices around a point."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from bidnerf_core.devices import constant

# The primes of eq. 4, modulo 2^32 and signed: int32 products wrap, and only their low bits are used.
PRIMES = (1, 2654435761 - 2**32, 805459861)


@dataclass(frozen=True)
class Level:
    """One level: a grid of vertices whose features are stored in a table with ``entries`` rows."""

    resolution: int  # cells along a side
    entries: int
    strides: tuple[int, int, int]  # factor of each coordinate in a vertex's table index
    hashed: bool

    def vertices(self, points: Float[Tensor, "3 m"]) -> tuple[Int[Tensor, "3 2 m"], Float[Tensor, "3 m"]]:
        """Return the index terms of a cell's lower and upper vertices along each axis, and the points' positions in the cell."""
        scaled = points * self.resolution
        # A coordinate of exactly 1 belongs to the last cell, whose upper vertices exist.
        lower = scaled.to(torch.int32).clamp_(0, self.resolution - 1)
        strides = constant(self.strides, lower)[:, None]
        terms = lower.new_empty(3, 2, lower.shape[1])
        torch.mul(lower, strides, out=terms[:, 0])
        torch.add(terms[:, 0], strides, out=terms[:, 1])
        if self.hashed:
            terms.bitwise_and_(self.entries - 1)
        return terms, scaled.sub_(lower)

    def corner_indices(self, terms: Int[Tensor, "3 2 m"]) -> Int[Tensor, " 8*m"]:
        """Return the table indices of the eight corners (eq. 4 if hashed, else dense), ordered (z, y, x, point)."""
        combine = torch.bitwise_xor if self.hashed else torch.add
        x, y, z = terms.unbind()
        return combine(combine(z[:, None], y)[:, :, None], x).view(-1)


def make_levels(count: int, table_size: int, base: float, finest: float) -> tuple[Level, ...]:
    """Return ``count`` levels with resolutions by eqs. 2 and 3; levels whose vertices fit into the table are not hashed."""
    growth = math.log(finest / base) / max(count - 1, 1)
    levels = []
    for index in range(count):
        # The small addend keeps an exact product, such as N_max itself, from being rounded down.
        resolution = math.floor(base * math.exp(growth * index) + 1e-6)
        side = resolution + 1
        hashed = side**3 > table_size
        strides = PRIMES if hashed else (1, side, side**2)
        levels.append(Level(resolution, table_size if hashed else side**3, strides, hashed))
    return tuple(levels)
