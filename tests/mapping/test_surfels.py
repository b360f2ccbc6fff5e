"""Surfels know the plane and the colours about them; their index: against the nearest of all, and its memory."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from torch import Generator, Tensor

from bidnerf_core.errors import InputError
from bidnerf_core.fields import SceneBounds, VoxelGrid
from bidnerf_core.geometry import SE3
from bidnerf_core.mapping import SurfelIndex

# Inside: merging and the blocks of the index are compared with a search of all surfels
from bidnerf_core.mapping.surface.surface_map import fuse_surfels, merge_cells
from bidnerf_core.mapping.surface.surfel_index import CELLS_OF_BLOCK, block_levels, block_shape, index_bytes
from voxels import cell_centres


def on_a_plane(generator: Generator, count: int = 400) -> tuple[torch.Tensor, torch.Tensor]:
    """Points of a plane, and its unit normal."""
    flat = torch.rand((count, 3), generator=generator) * torch.tensor([1.0, 1.0, 0.0])
    turn = SE3.exp(torch.tensor([0.3, -0.2, 0.1, 0.5, 0.7, -0.4]))
    return turn.apply(flat), turn.rotation[:, 2]


def test_a_plane_is_left_where_it_is_and_has_its_normal(generator: Generator) -> None:
    points, normal = on_a_plane(generator)
    surfels = fuse_surfels(points, torch.rand((len(points), 3), generator=generator))
    assert len(surfels) == len(points)
    assert torch.allclose(surfels.positions, points, atol=1e-5)
    assert torch.allclose((surfels.normals @ normal).abs(), torch.ones(len(points)), atol=1e-4)


def test_noise_across_the_plane_is_averaged(generator: Generator) -> None:
    points, normal = on_a_plane(generator, 2000)
    noise = 0.005 * torch.randn((len(points), 1), generator=generator)
    off = (fuse_surfels(points + noise * normal, points).positions - points.mean(0)) @ normal
    assert off.std() < 0.5 * noise.std()


def test_a_linear_colour_has_its_gradient_within_the_plane(generator: Generator) -> None:
    points, normal = on_a_plane(generator)
    slope = torch.randn((3, 3), generator=generator)  # channel by axis
    surfels = fuse_surfels(points, points @ slope.T)
    within = slope - (slope @ normal)[:, None] * normal
    error = torch.linalg.matrix_norm(surfels.rgb_gradient - within)
    assert error.median() < 0.06 * torch.linalg.matrix_norm(within)  # a little weight tames thin strips
    assert (surfels.rgb_gradient @ surfels.normals[..., None]).abs().max() < 1e-3


def test_one_colour_has_no_gradient(generator: Generator) -> None:
    points, _ = on_a_plane(generator)
    surfels = fuse_surfels(points, torch.full((len(points), 3), 0.3))
    assert surfels.rgb_gradient.abs().max() < 1e-4
    assert torch.allclose(surfels.rgb, torch.tensor(0.3))


@pytest.mark.parametrize("count", [1, 2, 3, 11, 13])
def test_few_points_in_a_row_are_surfels_too(count: int) -> None:
    points = torch.arange(count)[:, None] * torch.tensor([0.1, 0.0, 0.0])
    surfels = fuse_surfels(points, points)
    for value in (surfels.positions, surfels.normals, surfels.rgb, surfels.rgb_gradient):
        assert len(value) == count
        assert value.isfinite().all()
    assert torch.allclose(torch.linalg.vector_norm(surfels.normals, dim=-1), torch.ones(count))


def test_points_of_a_cell_become_their_mean(generator: Generator) -> None:
    cells = torch.randint(7, (50,), generator=generator) * 3
    points, weights = torch.rand((50, 3), generator=generator), torch.rand((50, 1), generator=generator)
    found, (means, others) = merge_cells(cells, points, weights)
    assert found.tolist() == sorted(set(cells.tolist()))
    for cell, mean, other in zip(found, means, others, strict=True):
        assert torch.allclose(mean, points[cells == cell].mean(0))
        assert torch.allclose(other, weights[cells == cell].mean(0))


BOUNDS = SceneBounds((-1.0, 0.0, 2.0), (1.0, 3.0, 2.9), 0.0, 10.0)
GRID = VoxelGrid.covering(BOUNDS, 0.02)
ROOT3 = 3**0.5


def inside(count: int, generator: Generator) -> Tensor:
    low, high = torch.tensor(GRID.lower), torch.tensor(GRID.upper)
    return low + (high - low) * torch.rand((count, 3), generator=generator)


def plane(height: float = 2.311, cell: float = 0.02) -> Tensor:
    """Return one surfel in each cell of a level plane."""
    sides = (torch.arange(low + cell / 2, high, cell) for low, high in ((-1.0, 1.0), (0.0, 3.0)))
    flat = torch.cartesian_prod(*sides)
    return torch.cat([flat, torch.full((len(flat), 1), height)], dim=1)


def distances(index: SurfelIndex, positions: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
    """Return the distances of the surfels that the index finds, and the least ones."""
    found = torch.linalg.vector_norm(points - positions[index(points)], dim=-1)
    least, _ = cKDTree(positions.numpy()).query(points.numpy())
    return found, torch.from_numpy(least).float()


@given(seed=st.integers(0, 2**31), count=st.integers(1, 60))
@settings(max_examples=12, deadline=None)
def test_the_surfel_found_is_nearly_the_nearest(seed: int, count: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    positions, points = inside(count, generator), inside(500, generator)
    found, least = distances(SurfelIndex.of(positions, GRID), positions, points)
    assert (found >= least - 1e-5).all()
    assert (found <= torch.maximum(least + ROOT3 * GRID.cell, (1 + ROOT3 / 2) * least) + 1e-5).all()


def test_beside_a_plane_the_distance_is_nearly_exact(generator: Generator) -> None:
    positions, points = plane(), inside(20_000, generator)
    index = SurfelIndex.of(positions, GRID)
    assert set(index.level.unique().tolist()) == {0, 1, 2, 3}
    found, least = distances(index, positions, points)
    assert (found <= torch.maximum(1.12 * least, least + GRID.cell)).all()
    assert float((found / least.clamp(min=GRID.cell)).mean()) < 1.02


def test_cells_of_their_own_are_looked_up_exactly(generator: Generator) -> None:
    grid = VoxelGrid((-0.3, 0.1, 5.0), 0.1, (9, 16, 3))
    level = torch.zeros(block_shape(grid), dtype=torch.uint8)
    first = CELLS_OF_BLOCK * torch.arange(level.numel(), dtype=torch.int32).view(level.shape)
    index = SurfelIndex(grid, first, level, torch.arange(CELLS_OF_BLOCK * level.numel(), dtype=torch.int32))
    nearest = index(cell_centres(grid))
    assert len(nearest.unique()) == nearest.numel()
    beyond = 3 * torch.randn((2, 500, 3), generator=generator)
    assert torch.equal(index(beyond), grid.at(nearest, beyond).long())
    assert torch.equal(index(beyond.double()), grid.at(nearest, beyond.double()).long())


def test_points_that_are_not_finite_have_some_surfel() -> None:
    index = SurfelIndex.of(plane(), GRID)
    odd = torch.tensor([[math.nan, 1.0, 2.3], [math.inf, -math.inf, 2.3], [1e38, -1e38, 0.0]])
    assert ((index(odd) >= 0) & (index(odd) < len(plane()))).all()
    assert index(torch.zeros((0, 3))).shape == (0,)
    assert index(torch.zeros((4, 0, 3))).shape == (4, 0)


def test_a_whole_number_of_cells_further_everything_is_the_same(generator: Generator) -> None:
    positions, points = inside(200, generator).double(), inside(3000, generator).double()
    shift = GRID.cell * torch.tensor([64.0, -32.0, 16.0], dtype=torch.float64)
    x, y, z = (torch.tensor(GRID.lower, dtype=torch.float64) + shift).tolist()
    here = SurfelIndex.of(positions, GRID)(points)
    there = SurfelIndex.of(positions + shift, replace(GRID, lower=(x, y, z)))(points + shift)
    assert float((here == there).double().mean()) > 0.999  # rounding moves a point across a border now and then


def test_memory_grows_with_the_surface_and_not_with_the_volume() -> None:
    sizes = {}
    for cell in (0.02, 0.01):
        grid = VoxelGrid.covering(BOUNDS, cell)
        levels = block_levels(plane(cell=cell), grid)
        index = SurfelIndex.of(plane(cell=cell), grid)
        assert index_bytes(levels) == 4 * len(index.entries) + 13 * levels.numel()
        sizes[cell] = index_bytes(levels)
    assert sizes[0.01] < 4.6 * sizes[0.02]
    assert sizes[0.01] < 4 * math.prod(VoxelGrid.covering(BOUNDS, 0.01).shape) / 3
    assert block_levels(plane()[:1], VoxelGrid.covering(BOUNDS, 0.003)).eq(3).float().mean() > 0.99


def test_blocks_near_surfels_are_resolved_to_cells(generator: Generator) -> None:
    positions = inside(5, generator)
    levels = block_levels(positions, GRID)
    blocks = VoxelGrid(GRID.lower, 8 * GRID.cell, (levels.shape[0], levels.shape[1], levels.shape[2]))
    assert (blocks.at(levels, positions) == 0).all()
    outside = ((cell_centres(blocks)[..., None, :] - positions).abs() - blocks.cell / 2).clamp(min=0)
    clear = torch.linalg.vector_norm(outside, dim=-1).amin(-1)
    shared = 2.0**levels * GRID.cell
    assert (clear[levels > 0] >= 2 * shared[levels > 0] - 1e-5).all()
    assert (clear[levels < 3] <= 24 * GRID.cell).all()  # far away, cells do share


def test_what_cannot_be_indexed_is_refused() -> None:
    with pytest.raises(InputError, match="no surface to bake"):
        SurfelIndex.of(torch.zeros((0, 3)), GRID)
    with pytest.raises(InputError, match="larger cells"):
        SurfelIndex.of(plane(), VoxelGrid.covering(BOUNDS, 1e-3 / CELLS_OF_BLOCK))
