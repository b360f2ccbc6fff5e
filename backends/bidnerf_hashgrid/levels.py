"""Levels of a hash encoding: their sizes, and the table indices of the vertices around a point."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import torch
from jaxtyping import Float, Int
from torch import Tensor

from bidnerf_core.devices import constant
from bidnerf_hashgrid.threads import slices

# The primes of eq. 4, modulo 2^32 and signed: int32 products wrap, and only their low bits are used.
PRIMES = (1, 2654435761 - 2**32, 805459861)
MOST_ENTRIES = 2**23
"""Limit of the entries of concatenated tables: concatenation copies some tens of megabytes. An int32 could address 2^31."""


@dataclass(frozen=True)
class Level:
    """A grid of vertices, whose features are stored in a table of ``entries``."""

    resolution: int  # cells along a side
    entries: int
    strides: tuple[int, int, int]  # factor of each coordinate in a vertex's table index
    hashed: bool


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


@dataclass(frozen=True)
class LevelGroup:
    """Adjacent levels that are computed together, with their tables concatenated: all of them hashed, or none."""

    levels: tuple[Level, ...]
    first: int  # number of the first among all levels

    def __len__(self) -> int:
        return len(self.levels)

    @property
    def span(self) -> slice:
        """The indices of these levels among all levels."""
        return slice(self.first, self.first + len(self))

    @property
    def entries(self) -> list[int]:
        return [level.entries for level in self.levels]

    def resolutions(self, like: Tensor) -> Float[Tensor, "k"]:
        return constant(tuple(level.resolution for level in self.levels), like)

    def vertices(self, points: Float[Tensor, "3 m"]) -> tuple[Int[Tensor, "3 2 k m"], Float[Tensor, "3 k m"]]:
        """Return each axis's terms of the corner indices, for its lower and upper vertex, and the position in the cell."""
        scaled = points[:, None] * self.resolutions(points)[:, None]
        lower = scaled.to(torch.int32).clamp_(min=0)
        # A coordinate of exactly 1 belongs to the last cell, whose upper vertices exist.
        last = constant(tuple(level.resolution - 1 for level in self.levels), lower)[:, None]
        torch.minimum(lower, last, out=lower)
        by_axis = zip(*(level.strides for level in self.levels), strict=True)
        strides = constant(tuple(stride for axis in by_axis for stride in axis), lower)
        terms = lower.new_empty(3, 2, *lower.shape[1:])
        torch.mul(lower, strides.view(3, -1, 1), out=terms[:, 0])
        torch.add(terms[:, 0], strides.view(3, -1, 1), out=terms[:, 1])
        if self.levels[0].hashed:
            terms.bitwise_and_(self.entries[0] - 1)
        if len(self) > 1:
            # A table's offset lies above all bits of a hash, so that the terms of the other axes leave it unchanged.
            terms[0] += constant(self._offsets, lower)[:, None]
        return terms, scaled.sub_(lower)

    def corner_indices(self, terms: Int[Tensor, "3 2 k m"]) -> Int[Tensor, " 8*k*m"]:
        """Return the table indices of the eight corners (eq. 4 if hashed, else dense), ordered (z, y, x, level, point)."""
        combine = torch.bitwise_xor if self.levels[0].hashed else torch.add
        x, y, z = terms.unbind()
        return combine(combine(z[:, None], y)[:, :, None], x).view(-1)

    @property
    def _offsets(self) -> tuple[int, ...]:
        return tuple(sum(self.entries[:k]) for k in range(len(self)))


@lru_cache(maxsize=64)
def one_by_one(levels: tuple[Level, ...]) -> list[LevelGroup]:
    """Return each level as a group of its own, so that its table stays in the cache of a core."""
    return [LevelGroup((level,), number) for number, level in enumerate(levels)]


@lru_cache(maxsize=64)
def together(levels: tuple[Level, ...]) -> list[LevelGroup]:
    """Return as few groups as possible: on a GPU, each operation costs a launch, however few points it has."""
    groups = []
    dense = sum(not level.hashed for level in levels)  # the coarse ones, which come first
    for first, kind in ((0, levels[:dense]), (dense, levels[dense:])):
        most = MOST_ENTRIES // max((level.entries for level in kind), default=1)
        groups += [LevelGroup(kind[part], first + part.start) for part in slices(len(kind), max(1, most))]
    return groups
