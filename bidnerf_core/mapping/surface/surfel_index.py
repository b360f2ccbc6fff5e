"""Index of surfels: finds the one nearest to a point in constant time, with memory proportional to the surface's area.

The cells of a voxel grid are grouped into blocks of 8 x 8 x 8. A dense table of blocks holds where each block's entries begin
and how many cells share an entry: one cell near the surface, and 2, 4 or 8 along each side farther away, so a block far from
any surface has a single entry. Within a block, cells are in Morton order (x, y and z interleaved bit by bit), so cells that
share an entry are consecutive. A look-up is three gathers for any point.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from scipy.ndimage import distance_transform_edt
from scipy.spatial import cKDTree
from torch import Tensor

from bidnerf_core.devices import move_to
from bidnerf_core.errors import InputError
from bidnerf_core.fields import VoxelGrid

BLOCK_SIDE = 8
"""Cells along the side of a block."""
CELLS_OF_BLOCK = BLOCK_SIDE**3
MOST_CELLS = 2**31 - 1
"""Maximum number of cells in all blocks, since cells are numbered in 32 bits."""
COARSER_FROM = (2.0, 3.5, 6.0)
"""Minimum distances of a block's octants from octants with surfels (centre to centre, in octants of 4 cells) for 2, 4 and 8
cells along each side to share an entry. All surfels are then at least twice that side away."""


@dataclass(frozen=True, eq=False)
class SurfelIndex:
    """Nearest-neighbour index of surfels, with an error of about a cell near the surface, and up to 87 % of the distance far from it."""

    grid: VoxelGrid
    first: Int[Tensor, "x y z"]  # int32: each block's first entry
    level: UInt8[Tensor, "x y z"]  # uint8: 2^level cells along each side share an entry
    entries: Int[Tensor, "e"]  # int32: the surfel nearest to the middle of the cells that share the entry

    @staticmethod
    def of(positions: Float[Tensor, "n 3"], grid: VoxelGrid) -> SurfelIndex:
        """Build the index of surfels at ``positions`` (metres, world).

        Raises ``InputError`` if there are none, or if the grid has more cells than can be numbered.
        """
        if not len(positions):
            raise InputError("no surface to bake: no point that several views agree on")
        level = block_levels(positions, grid)
        counts = CELLS_OF_BLOCK >> 3 * level.view(-1).long()
        first = (counts.cumsum(0) - counts).int().view(level.shape)
        # Leaves of 32 surfels were the fastest in measurements with points some cells away from a plane of surfels.
        tree = cKDTree(positions.numpy(), leafsize=32)
        return SurfelIndex(grid, first, level, _nearest_to_middles(tree, grid, level))

    def __call__(self, points: Float[Tensor, "*p 3"]) -> Int[Tensor, "*p"]:
        """Return the index (int64) of the surfel nearest to each point (metres, world).

        The distance to that surfel exceeds the smallest by at most sqrt(3) cells or 87 % of the smallest, whichever is more;
        near a plane, by 10 %. A point outside the grid is first clamped to the grid's border; a non-finite point gets an
        arbitrary surfel.
        """
        offset, rate, cells, base = self._numbering
        flat = points.detach().reshape(-1, 3).T
        slots = torch.addmm(offset.to(flat.dtype), rate.to(flat.dtype), flat)
        slots = slots.nan_to_num_(0.0).clamp_(0, len(cells) // 3 - 1).int().add_(base)
        x, y, z = cells.index_select(0, slots.view(-1)).view(3, -1)
        number = x.add_(y).add_(z)
        start, shift = self._blocks
        block = number >> 9  # number = 512 block + Morton number of the cell in it
        number.bitwise_right_shift_(shift.index_select(0, block)).add_(start.index_select(0, block))
        return self.entries.index_select(0, number).view(points.shape[:-1]).long()

    def warm_up(self) -> None:
        """Compute the cached tables now, so that the first look-up takes no longer than the others."""
        _ = self._numbering, self._blocks

    @cached_property
    def _numbering(
        self,
    ) -> tuple[Float[Tensor, "3 1"], Float[Tensor, "3 3"], Int[Tensor, "c"], Int[Tensor, "3 1"]]:
        """Tables that convert points to cell numbers.

        ``offset + rate point`` is a position in each axis's part (starting at ``base``) of a table of terms; a cell's number is
        the sum of its three terms. Each part has an extra cell at either end, which repeats the border.
        """
        longest = max(self.grid.shape) + 2
        _, y, z = block_shape(self.grid)
        parts, strides = [], (y * z, z, 1)
        for axis, count in enumerate(self.grid.shape):
            cell = (torch.arange(longest) - 1).clamp(0, count - 1)
            within = torch.zeros((longest, 3), dtype=torch.int64)
            within[:, axis] = cell % BLOCK_SIDE
            parts.append(cell // BLOCK_SIDE * strides[axis] * CELLS_OF_BLOCK + _morton(within))
        rate = torch.eye(3) / self.grid.cell
        offset = 1 - torch.tensor(self.grid.lower, dtype=torch.float64) / self.grid.cell
        base = longest * torch.arange(3, dtype=torch.int32)[:, None]
        return move_to((offset.float()[:, None], rate, torch.cat(parts).int(), base), self.entries.device)

    @cached_property
    def _blocks(self) -> tuple[Int[Tensor, "b"], Int[Tensor, "b"]]:
        """Each block's ``start`` and ``shift``: a cell's entry is ``start + (number >> shift)``."""
        shift = 3 * self.level.view(-1).long()
        numbers = torch.arange(shift.numel(), device=shift.device)
        start = self.first.view(-1) - (numbers * CELLS_OF_BLOCK >> shift)
        return start.int(), shift.int()


def block_shape(grid: VoxelGrid) -> tuple[int, int, int]:
    """Return the number of blocks along x, y and z. Raises ``InputError`` if they have too many cells to be numbered."""
    x, y, z = (-(-count // BLOCK_SIDE) for count in grid.shape)
    if x * y * z * CELLS_OF_BLOCK > MOST_CELLS:
        raise InputError(
            f"the surface's grid has {x * y * z * CELLS_OF_BLOCK} cells",
            expected=f"at most {MOST_CELLS}; use larger cells",
        )
    return x, y, z


def block_levels(positions: Float[Tensor, "n 3"], grid: VoxelGrid) -> UInt8[Tensor, "x y z"]:
    """Return the level (see ``SurfelIndex``) of each block of ``grid``, for surfels at ``positions`` (metres, world)."""
    x, y, z = block_shape(grid)
    octants = VoxelGrid(grid.lower, BLOCK_SIDE / 2 * grid.cell, (2 * x, 2 * y, 2 * z))
    empty: Bool[Tensor, "x y z"] = torch.ones(octants.shape, dtype=torch.bool)
    empty.view(-1)[octants.numbers(positions)] = False
    away = torch.from_numpy(distance_transform_edt(empty.numpy()).astype(np.float32))
    nearest = away.view(x, 2, y, 2, z, 2).amin((1, 3, 5))
    return torch.bucketize(nearest, torch.tensor(COARSER_FROM), right=True).to(torch.uint8)


def index_bytes(level: UInt8[Tensor, "x y z"]) -> int:
    """Return the memory (bytes) of an index with blocks of these levels: 4 per entry, and 13 per block."""
    return 4 * int((CELLS_OF_BLOCK >> 3 * level.long()).sum()) + 13 * level.numel()


def _morton(cells: Int[Tensor, "*c 3"]) -> Int[Tensor, "*c"]:
    """Return the Morton numbers of cells of a block, with z in the lowest bit."""
    spread = (cells & 1) | (cells & 2) << 2 | (cells & 4) << 4
    return (spread[..., 0] << 2) | (spread[..., 1] << 1) | spread[..., 2]


def _nearest_to_middles(tree: cKDTree, grid: VoxelGrid, level: UInt8[Tensor, "x y z"]) -> Int[Tensor, "e"]:
    """Return, for each entry, the surfel nearest to the middle of the cells that share the entry."""
    corners = torch.cartesian_prod(*3 * [torch.arange(BLOCK_SIDE)])
    corners = corners[_morton(corners).argsort()]
    levels, parts = level.view(-1).long(), []
    step = 2**20 // CELLS_OF_BLOCK  # at most a million entries are computed at once
    for at in range(0, len(levels), step):
        number = torch.arange(at, min(at + step, len(levels)))
        block = torch.stack(torch.unravel_index(number, level.shape), dim=-1)
        counts = CELLS_OF_BLOCK >> 3 * levels[number]
        which = torch.arange(len(number)).repeat_interleave(counts)
        within = torch.arange(len(which)) - (counts.cumsum(0) - counts)[which]
        shift = levels[number][which]
        cell = BLOCK_SIDE * block[which] + corners[within << 3 * shift]
        middle = cell + 0.5 * (1 << shift)[:, None]
        points = torch.tensor(grid.lower, dtype=torch.float64) + middle.double() * grid.cell
        _, nearest = tree.query(points.numpy(), workers=-1)
        parts.append(torch.from_numpy(np.asarray(nearest, dtype=np.int32)))
    return torch.cat(parts)
