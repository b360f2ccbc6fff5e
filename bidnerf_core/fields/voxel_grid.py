"""Voxel grids: cubic cells that cover a box, and look-up of cell values at points.

A grid is only geometry; the values of its cells are tensors of its shape, stored by the classes that use it.
All look-ups go through ``VoxelGrid.at``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor, nn

from bidnerf_core.fields.contract import Rays, SceneBounds


@dataclass(frozen=True)
class VoxelGrid:
    """Cubic cells, axis-aligned in the world. Cell indices count z fastest, then y, then x."""

    lower: tuple[float, float, float]  # metres, world: lower corner of the first cell
    cell: float  # metres: side of a cell
    shape: tuple[int, int, int]  # cells along x, y and z
    # The scene whose contracted space the grid divides, in the coordinates of ``SceneBounds.normalized``;
    # None: the world.
    contracted: SceneBounds | None = None

    @staticmethod
    def cube(bounds: SceneBounds, resolution: int) -> VoxelGrid:
        """Return the grid of the modelled cube, ``resolution`` cells wide.

        This is the cube around the box's centre with the box's longest side or, if the scene is contracted,
        the cube into which all space is contracted.
        """
        if bounds.contracted:
            return VoxelGrid((-1.0, -1.0, -1.0), 2 / resolution, (resolution,) * 3, bounds)
        side = max(bounds.size)
        x, y, z = (middle - side / 2 for middle in bounds.centre)
        return VoxelGrid((x, y, z), side / resolution, (resolution, resolution, resolution))

    @staticmethod
    def filling(bounds: SceneBounds, cells: int) -> VoxelGrid:
        """Return the finest grid, to within a few per cent, that covers the box with at most ``cells`` cells."""
        cell = (math.prod(bounds.size) / cells) ** (1 / 3)
        while True:
            x, y, z = (math.ceil(side / cell) for side in bounds.size)
            if x * y * z <= cells:
                return VoxelGrid(bounds.lower, cell, (x, y, z))
            cell *= 1.01  # the last cell of each row reaches beyond the box

    @staticmethod
    def covering(bounds: SceneBounds, cell: float) -> VoxelGrid:
        """Return the grid of cells of side ``cell`` (metres) that covers the box and begins at its lower corner."""
        x, y, z = (max(1, math.ceil(side / cell)) for side in bounds.size)
        return VoxelGrid(bounds.lower, cell, (x, y, z))

    @property
    def upper(self) -> tuple[float, float, float]:
        """Upper corner of the last cell (metres, world)."""
        x, y, z = (low + count * self.cell for low, count in zip(self.lower, self.shape, strict=True))
        return x, y, z

    @property
    def centre(self) -> tuple[float, float, float]:
        """Centre of the grid (metres, world)."""
        x, y, z = ((low + high) / 2 for low, high in zip(self.lower, self.upper, strict=True))
        return x, y, z

    def numbers(self, points: Float[Tensor, "*p 3"]) -> Int[Tensor, "*p"]:
        """Return the index of the cell that holds each point (metres, world), or of the nearest border cell.

        Points that are not finite get the index of an arbitrary cell.
        """
        points, rate = self._own(points.detach()), 1 / self.cell
        x, y, z = (
            ((points[..., axis] - self.lower[axis]) * rate).nan_to_num_(0.0).clamp_(0, count - 1).long()
            for axis, count in enumerate(self.shape)
        )
        return (x * self.shape[1] + y) * self.shape[2] + z

    def at(self, values: Shaped[Tensor, "x y z"], points: Float[Tensor, "*p 3"]) -> Shaped[Tensor, "*p"]:
        """Return the value of the cell that holds each point (metres, world), or of the nearest border cell."""
        numbers = self.numbers(points)
        # On a CPU this is several times faster than indexing with square brackets.
        return values.view(-1).index_select(0, numbers.reshape(-1)).view(numbers.shape)

    def contains(self, points: Float[Tensor, "*p 3"]) -> Bool[Tensor, "*p"]:
        """Return whether each point (metres, world) lies within the grid or on its border."""
        points = self._own(points)
        x, y, z = (
            (points[..., axis] >= low) & (points[..., axis] <= high)
            for axis, (low, high) in enumerate(zip(self.lower, self.upper, strict=True))
        )
        return x & y & z

    def _own(self, points: Float[Tensor, "*p 3"]) -> Float[Tensor, "*p 3"]:
        """Convert points (metres, world) to the grid's own coordinates."""
        return points if self.contracted is None else self.contracted.normalized(points)

    def rays(self, origins: Float[Tensor, "*r 3"], directions: Float[Tensor, "*r 3"]) -> Rays:
        """Return the half-lines (metres, world; unit directions), limited to the grid."""
        return SceneBounds(self.lower, self.upper, 0.0, 1e9).rays(origins, directions)


class OccupancyMask(nn.Module):
    """A grid whose cells are marked as empty or as possibly occupied by matter; initially, all are occupied."""

    cells: Bool[Tensor, "x y z"]

    def __init__(self, grid: VoxelGrid) -> None:
        super().__init__()
        self.grid = grid
        self.register_buffer("cells", torch.ones(grid.shape, dtype=torch.bool))

    def holds(self, positions: Float[Tensor, "*p 3"]) -> Bool[Tensor, "*p"]:
        """Return whether there may be matter at ``positions`` (metres, world).

        Positions outside the grid take the value of the nearest border cell.
        """
        return self.grid.at(self.cells, positions)
