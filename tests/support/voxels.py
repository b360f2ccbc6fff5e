"""Where the cells of a voxel grid are."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.fields import VoxelGrid


def cell_centres(grid: VoxelGrid) -> Float[Tensor, "x y z 3"]:
    """Return the centre of each cell (metres, world)."""
    axes = [low + (torch.arange(count) + 0.5) * grid.cell for low, count in zip(grid.lower, grid.shape, strict=True)]
    return torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1)


def cells_of(grid: VoxelGrid, positions: Float[Tensor, "p 3"]) -> tuple[Tensor, ...]:
    """Return the indices x, y, z of the cell of each position, by division in float64: an oracle for the look-up."""
    places = (positions.double() - torch.tensor(grid.lower, dtype=torch.float64)) / grid.cell
    last = torch.tensor(grid.shape) - 1
    return places.floor().long().clamp(min=torch.zeros_like(last), max=last).unbind(-1)
