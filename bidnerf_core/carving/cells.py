"""Carving: cells of a box are emptied if views see through them. A cell is represented by its circumscribed sphere."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from bidnerf_core.carving.free_space import FreeSpace
from bidnerf_core.devices import moved, threads_at_most
from bidnerf_core.fields import VoxelGrid
from bidnerf_core.frames import View

CPU = torch.device("cpu")
BLOCK = 8
"""Cells along the side of a block. Processing a block for a view that does not see it costs next to nothing."""


def occupied_voxels(
    views: Sequence[View], grid: VoxelGrid, device: torch.device = CPU
) -> Bool[Tensor, "x y z"]:
    """Return which cells of ``grid`` may hold matter, see ``occupied_cells``.

    The relative tolerance of depth is 5 %, since sensors err by a few per cent, and an emptied cell is never filled again.
    In contracted space, the inner half of the grid, whose shape is divisible by 4, is the box; cells outside of the box
    are always kept.
    """
    inner, middle = grid, [slice(None)] * 3
    if grid.contracted is not None:
        quarter = grid.shape[0] // 4
        inner = VoxelGrid.cube(replace(grid.contracted, contracted=False), 2 * quarter)
        middle = [slice(quarter, quarter + inner.shape[0])] * 3
    occupied = torch.ones(grid.shape, dtype=torch.bool, device=device)
    occupied[middle[0], middle[1], middle[2]] = occupied_cells(
        views, inner.lower, inner.upper, inner.shape, 0.05, device=device
    )
    return occupied


def occupied_cells(
    views: Sequence[View],
    lower: Sequence[float],
    upper: Sequence[float],
    shape: tuple[int, int, int],
    tolerance: float = 0.02,
    footprint: int = 8,
    device: torch.device = CPU,
) -> Bool[Tensor, "nx ny nz"]:
    """Return on ``device`` which cells of the box ``lower``..``upper`` (metres, world) may hold matter.

    A cell is emptied when two views (one, if there is only one) see all of it as free: as background (alpha 0), or nearer
    than the measured depth by more than a fraction ``tolerance`` of that depth. Pixels without a measurement empty nothing, nor
    does a view in which the cell's radius is over ``footprint`` pixels.

    Cells are processed in blocks, which may reach beyond the box.
    """
    counts = [-(-count // BLOCK) for count in shape]
    first = torch.tensor(lower, dtype=torch.float64)
    size = (torch.tensor(upper, dtype=torch.float64) - first) / torch.tensor(shape)  # of a cell
    radius = torch.linalg.vector_norm(size).item() / 2
    blocks, cells = _indices(counts), _indices([BLOCK] * 3)
    votes = torch.zeros(blocks.shape[1], BLOCK**3, dtype=torch.uint8, device=device)
    needed = 1 if len(views) < 2 else 2
    undecided = torch.ones(len(votes), dtype=torch.bool, device=device)
    at_once = 128 if device.type == "cpu" else max(1, len(votes))  # so few blocks stay in the cache
    with threads_at_most(1):  # the operations are short
        for view in (view for view in views if view.frame.has_depth or view.frame.alpha is not None):
            space = moved(FreeSpace.seen_by(view, tolerance, footprint), device)
            # In double precision, since the world's origin may be far away.
            T_camera_world = view.T_ref_camera.to(torch.float64).inverse()
            # The middles of the blocks' first cells, and the offsets of a block's cells from them (metres, camera frame)
            step = T_camera_world.rotation * size
            corner = T_camera_world.apply(first + size / 2)[:, None] + step @ (blocks * BLOCK).double()
            corners, within = moved((corner.float(), (step @ cells.double()).float()), device)
            seen = space.may_free(corners + within.mean(dim=1, keepdim=True), BLOCK * radius)
            for rows in (seen & undecided).nonzero()[:, 0].split(at_once):
                points = (corners[:, rows, None] + within[:, None, :]).flatten(1)
                freed = space.frees(points, radius).unflatten(0, (-1, BLOCK**3))
                votes[rows] = (votes[rows] + freed).clamp(max=needed)  # a byte would overflow with many views
                undecided[rows] = (votes[rows] < needed).any(dim=1)
        whole = (votes < needed).reshape(*counts, BLOCK, BLOCK, BLOCK).permute(0, 3, 1, 4, 2, 5)
        whole = whole.reshape([count * BLOCK for count in counts])
        return whole[: shape[0], : shape[1], : shape[2]].contiguous()


def _indices(counts: Sequence[int]) -> Int[Tensor, "3 n"]:
    return torch.cartesian_prod(*(torch.arange(count) for count in counts)).T
