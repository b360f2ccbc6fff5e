"""The cell size of a surface: as fine as the images resolve and their accuracy and a memory limit allow."""

from __future__ import annotations

import math
import statistics
import warnings
from collections.abc import Callable, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.depth import UNKNOWN
from bidnerf_core.errors import InputError, InputWarning
from bidnerf_core.fields import SceneBounds, VoxelGrid
from bidnerf_core.geometry import mad_deviation
from bidnerf_core.mapping.surface.posed_depth import PosedDepthImage, witnesses
from bidnerf_core.mapping.surface.surface_map import surfel_bytes
from bidnerf_core.mapping.surface.surfel_index import BLOCK_SIDE, MOST_CELLS, block_levels, index_bytes

COARSER = 2**0.25
"""Factor by which cells grow until they contain enough points and fit into memory."""


def finest_cell(images: Sequence[PosedDepthImage], opacity: float) -> float:
    """Return the finest cell (metres) that the images' resolution and the noise of measured depth justify.

    It is 0.7 times a pixel's footprint, since several images together resolve more than one, and at least two standard
    deviations of depth: with finer cells, a plane would become several layers of surfels. Rendered images are too sparsely
    sampled to distinguish noise from scene structure.
    """
    measured = [posed for posed in images if posed.measured]
    return max(0.7 * footprint(images, opacity), 2 * depth_noise(measured, opacity))


def footprint(images: Sequence[PosedDepthImage], opacity: float) -> float:
    """Return the footprint (side, metres) of a full-resolution pixel at the median distance; 0 if no surface is visible."""
    return _median([float(d.median()) / posed.full_focal for posed, d in _depths(images, opacity)])


def spacing(images: Sequence[PosedDepthImage], opacity: float) -> float:
    """Return the footprint (side, metres) of a pixel of the subsampled images at the median distance."""
    return _median([float(d.median()) / posed.focal for posed, d in _depths(images, opacity)])


def depth_noise(images: Sequence[PosedDepthImage], opacity: float) -> float:
    """Return the standard deviation (metres) of an image's depth, from differences between images of the same points.

    It includes pose errors. It is 0 if no two images show the same points.
    """
    return _spread(images, opacity, lambda posed, points: posed.smoothly_beyond(points, opacity))


def comparison_noise(images: Sequence[PosedDepthImage], opacity: float) -> float:
    """Return the standard deviation (metres) of the depth differences on which ``agreed`` sets its tolerance, per image.

    Like ``depth_noise``, but depth is read from the nearest pixel instead of interpolated, as ``agreed`` does, so the result
    includes the discretization error of the subsampled images.
    """
    return _spread(images, opacity, PosedDepthImage.beyond)


def _spread(
    images: Sequence[PosedDepthImage],
    opacity: float,
    beyond: Callable[[PosedDepthImage, Float[Tensor, "p 3"]], Float[Tensor, "p"]],
) -> float:
    """Return the robust deviation of the differences at up to 400 points of each of 40 images.

    Differences of more than five times the median are occlusions or gross errors. The result is at most two standard deviations
    of an unknown sensor, since images that differ by more are inconsistent.
    """
    found = [torch.zeros(0)]
    for number in range(0, len(images), max(1, math.ceil(len(images) / 40))):
        points = images[number].points(images[number].solid(opacity))
        points = points[:: max(1, len(points) // 400)]
        found += [beyond(images[other], points).abs() for other in witnesses(number, images)]
    differences = torch.cat(found)
    differences = differences[differences.isfinite()]
    if not len(differences):
        return 0.0
    near = differences[differences <= 5 * differences.median()]
    distance = _median([float(depths.median()) for _, depths in _depths(images, opacity)])
    return min(mad_deviation(near) / math.sqrt(2), 2 * UNKNOWN.noise.deviation(distance))


def chosen_grid(
    points: Float[Tensor, "p 3"], bounds: SceneBounds, finest: float, coarsest: float, megabytes: float
) -> VoxelGrid:
    """Return a grid with cells of ``finest`` metres, or coarser if points (metres, world) or memory are scarce.

    Points are scarce below 1.32 per occupied cell. At that number, randomly scattered ones leave 5/9 of the cells empty; with
    fewer, the mean distance between surfels exceeds the radius of their discs, which is 1.5 cells. Cells then grow up to
    ``coarsest`` at most, at which each contains a pixel. If the limit of ``megabytes`` makes them larger, an ``InputWarning``
    states by how much. Raises ``InputError`` if no cell size satisfies that limit.
    """
    grid = VoxelGrid.covering(bounds, finest)
    while grid.cell < coarsest and len(points) < 1.32 * len(grid.numbers(points).unique()):
        grid = VoxelGrid.covering(bounds, min(COARSER * grid.cell, coarsest))
    wished, needed = grid, surface_bytes(points, grid)
    while surface_bytes(points, grid) > 1e6 * megabytes:
        if grid.cell > max(bounds.size):
            raise InputError(f"no surface fits into {megabytes:g} MB; allow more megabytes")
        grid = VoxelGrid.covering(bounds, COARSER * grid.cell)
    if grid is not wished:
        size = "too many cells" if math.isinf(needed) else f"{needed / 1e6:.0f} MB"
        warnings.warn(
            f"the surface would take {size} with cells of {wished.cell:.3g}; cells of {grid.cell:.3g} keep it within"
            f" {megabytes:g} MB; raise this limit with 'bake --megabytes'",
            InputWarning,
            stacklevel=2,
        )
    return grid


def surface_bytes(points: Float[Tensor, "p 3"], grid: VoxelGrid) -> float:
    """Return the memory (bytes) of a surface from these points (metres, world); infinite if it has too many cells."""
    if math.prod(-(-count // BLOCK_SIDE) * BLOCK_SIDE for count in grid.shape) > MOST_CELLS:
        return math.inf
    surfels = len(grid.numbers(points).unique())
    return surfel_bytes(surfels) + index_bytes(block_levels(points, grid))


def _depths(
    images: Sequence[PosedDepthImage], opacity: float
) -> list[tuple[PosedDepthImage, Float[Tensor, "p"]]]:
    """Return the images that show a surface, with the depths of their pixels on it (metres)."""
    found = [(posed, posed.image.depth[posed.solid(opacity)]) for posed in images]
    return [(posed, depths) for posed, depths in found if len(depths)]


def _median(values: Sequence[float]) -> float:
    return statistics.median(values) if values else 0.0
