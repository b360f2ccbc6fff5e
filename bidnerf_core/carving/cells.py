"""Carving: cells of a box are emptied if views see through them. A cell is represented by its circumscribed sphere."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from bidnerf_core.carving.boxes import Corner
from bidnerf_core.carving.free_space import FreeSpace
from bidnerf_core.devices import moved, threads_at_most
from bidnerf_core.fields import SceneBounds, VoxelGrid
from bidnerf_core.frames import View
from bidnerf_core.geometry import SE3

CPU = torch.device("cpu")
BLOCK = 8
"""Cells along the side of a block. Processing a block for a view that does not see it costs next to nothing."""
BLOCKS_AT_ONCE = 128
"""Blocks that are processed together: few enough to stay in the cache."""
SENSOR_TOLERANCE = 0.05
"""Relative depth error that training allows for: sensors err by a few per cent, and an emptied cell is never
filled again."""


def occupied_voxels(
    views: Sequence[View], grid: VoxelGrid, tolerance: float = SENSOR_TOLERANCE, device: torch.device = CPU
) -> Bool[Tensor, "x y z"]:
    """Return which cells of ``grid`` may hold matter, see ``occupied_cells``. Contracted cells always may."""
    if grid.contracted is not None:
        return _within_contraction(views, grid, grid.contracted, tolerance, device)
    return occupied_cells(views, grid.lower, grid.upper, grid.shape, tolerance, device=device)


def _within_contraction(
    views: Sequence[View], grid: VoxelGrid, bounds: SceneBounds, tolerance: float, device: torch.device
) -> Bool[Tensor, "x y z"]:
    """Carve the inner half of a grid in contracted space, the cube around the box. The grid's shape is divisible by 4."""
    held = torch.ones(grid.shape, dtype=torch.bool, device=device)
    inner = VoxelGrid.cube(replace(bounds, contracted=False), grid.shape[0] // 2)
    quarter = grid.shape[0] // 4
    middle = slice(quarter, quarter + inner.shape[0])
    held[middle, middle, middle] = occupied_voxels(views, inner, tolerance, device)
    return held


def occupied_cells(
    views: Sequence[View],
    lower: Corner,
    upper: Corner,
    shape: tuple[int, int, int] = (128, 128, 128),
    tolerance: float = 0.02,
    footprint: int = 8,
    device: torch.device = CPU,
) -> Bool[Tensor, "nx ny nz"]:
    """Return on ``device`` which cells of the box ``lower``..``upper`` (metres, world) may hold matter.

    A cell is emptied when two views (one, if there is only one) see all of it as free: as background (alpha 0), or nearer
    than the measured depth by more than the fraction ``tolerance`` of it. Pixels without a measurement empty nothing, nor
    does a view in which the cell's radius is over ``footprint`` pixels.
    """
    grid = _Blocks(lower, upper, shape)
    votes = torch.zeros(grid.blocks.shape[1], BLOCK**3, dtype=torch.uint8, device=device)
    needed = 1 if len(views) < 2 else 2
    undecided = torch.ones(len(votes), dtype=torch.bool, device=device)
    at_once = BLOCKS_AT_ONCE if device.type == "cpu" else max(1, len(votes))
    with threads_at_most(1):  # the operations are short
        for view in (view for view in views if view.frame.has_depth or view.frame.alpha is not None):
            space = moved(FreeSpace.seen_by(view, tolerance, footprint), device)
            firsts, within = moved(grid.middles(view.T_ref_camera), device)
            seen = space.may_free(firsts + within.mean(dim=1, keepdim=True), grid.block_radius)
            for rows in (seen & undecided).nonzero()[:, 0].split(at_once):
                points = (firsts[:, rows, None] + within[:, None, :]).flatten(1)
                freed = space.frees(points, grid.cell_radius).unflatten(0, (-1, BLOCK**3))
                votes[rows] = (votes[rows] + freed).clamp(max=needed)  # a byte would overflow with many views
                undecided[rows] = (votes[rows] < needed).any(dim=1)
        return grid.assembled(votes < needed)


class _Blocks:
    """The cells of a box, in blocks of equal numbers of cells; the blocks may reach beyond the box."""

    def __init__(self, lower: Corner, upper: Corner, shape: tuple[int, int, int]) -> None:
        self.shape = shape
        self.counts = [-(-count // BLOCK) for count in shape]
        self.lower = torch.tensor(lower, dtype=torch.float64)
        self.size = (torch.tensor(upper, dtype=torch.float64) - self.lower) / torch.tensor(shape)  # of a cell
        self.blocks = _indices(self.counts)
        self.cell_radius = torch.linalg.vector_norm(self.size).item() / 2
        self.block_radius = self.cell_radius * BLOCK

    def middles(self, T_world_camera: SE3) -> tuple[Float[Tensor, "3 b"], Float[Tensor, "3 c"]]:
        """Return the centre of each block's first cell, and the offsets of a block's cells from it (metres, camera frame)."""
        T_camera_world = T_world_camera.to(torch.float64).inverse()  # the world's origin may be far away
        first = T_camera_world.apply(self.lower + self.size / 2)[:, None]
        step = T_camera_world.rotation * self.size
        within = step @ _indices([BLOCK] * 3).double()
        return (first + step @ (self.blocks * BLOCK).double()).float(), within.float()

    def assembled(self, values: Bool[Tensor, "b c"]) -> Bool[Tensor, "nx ny nz"]:
        """Return the blocks' values as one array, cropped to the box."""
        whole = values.reshape(*self.counts, BLOCK, BLOCK, BLOCK).permute(0, 3, 1, 4, 2, 5)
        nx, ny, nz = self.shape
        return whole.reshape([count * BLOCK for count in self.counts])[:nx, :ny, :nz].contiguous()


def _indices(counts: Sequence[int]) -> Int[Tensor, "3 n"]:
    axes = [torch.arange(count) for count in counts]
    return torch.stack(torch.meshgrid(*axes, indexing="ij")).flatten(1)
