"""Voxel grids: which cell a point is in, at the border and beyond it, in any precision and on any side of the world."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Generator

from bidnerf_core.fields import OccupancyMask, SceneBounds, VoxelGrid
from voxels import cell_centres, cells_of

BOUNDS = SceneBounds((-1.2, -0.4, 0.1), (0.8, 0.7, 1.3), 0.1, 8.0)
GRID = VoxelGrid((-1.2, -0.4, 0.1), 0.17, (12, 7, 8))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_cell_s_centre_is_in_that_cell(dtype: torch.dtype) -> None:
    centres = cell_centres(GRID).to(dtype)
    assert torch.equal(GRID.numbers(centres), torch.arange(math.prod(GRID.shape)).reshape(GRID.shape))
    assert bool(GRID.contains(centres).all())


def test_points_are_in_the_cell_that_division_gives(generator: Generator) -> None:
    points = 4 * torch.rand((5000, 3), generator=generator, dtype=torch.float64) - 2
    values = torch.rand(GRID.shape, generator=generator)
    assert torch.equal(GRID.at(values, points), values[cells_of(GRID, points)])
    assert 0.02 < float(GRID.contains(points).float().mean()) < 0.5


def test_beyond_the_grid_the_nearest_border_cell_counts(generator: Generator) -> None:
    lower, upper = torch.tensor(GRID.lower), torch.tensor(GRID.upper)
    for size in (3.0, 1e4, 1e30):
        points = size * torch.randn((500, 3), generator=generator)
        clamped = torch.minimum(torch.maximum(points, lower), upper - 1e-4)
        assert torch.equal(GRID.numbers(points), GRID.numbers(clamped))


def test_any_number_at_all_has_a_cell() -> None:
    odd = torch.tensor([math.nan, math.inf, -math.inf, 0.0, 3e38, -3e38])
    numbers = GRID.numbers(torch.cartesian_prod(odd, odd, odd))
    assert 0 <= int(numbers.min()) <= int(numbers.max()) < math.prod(GRID.shape)
    assert GRID.numbers(torch.full((3,), math.inf)) == math.prod(GRID.shape) - 1
    assert GRID.numbers(torch.full((3,), -math.inf)) == 0
    assert not bool(GRID.contains(torch.tensor([[math.nan, 0.0, 0.5], [math.inf, 0.0, 0.5]])).any())


def test_a_look_up_carries_no_gradient_and_leaves_the_points_as_they_are() -> None:
    points = torch.rand(5, 3, requires_grad=True)
    before = points.detach().clone()
    assert not GRID.numbers(points).requires_grad
    assert torch.equal(points.detach(), before)


def test_the_cube_has_the_centre_and_the_longest_side_of_the_box() -> None:
    grid = VoxelGrid.cube(BOUNDS, 10)
    assert grid.shape == (10, 10, 10)
    assert grid.cell == pytest.approx(0.2)
    assert grid.centre == pytest.approx(BOUNDS.centre)
    assert bool(grid.contains(torch.tensor([BOUNDS.lower, BOUNDS.upper], dtype=torch.float64)).all())


@given(
    sides=st.tuples(*[st.floats(1e-3, 1e3)] * 3),
    cells=st.integers(1000, 10**7),
)
def test_a_filling_grid_covers_the_box_with_at_most_so_many_cells(
    sides: tuple[float, float, float], cells: int
) -> None:
    bounds = SceneBounds((0.0, 0.0, 0.0), sides, 0.0, 1.0)
    grid = VoxelGrid.filling(bounds, cells)
    assert math.prod(grid.shape) <= cells
    assert grid.lower == bounds.lower
    assert all(high >= side * (1 - 1e-12) for high, side in zip(grid.upper, sides, strict=True))
    smaller = grid.cell / 1.02  # one that is a little finer would have too many, or this is the first that was tried
    finer = math.prod(math.ceil(side / smaller) for side in sides)
    assert finer > cells or grid.cell == (math.prod(bounds.size) / cells) ** (1 / 3)


def test_rays_end_at_the_grid(generator: Generator) -> None:
    origins = torch.randn((300, 3), generator=generator, dtype=torch.float64)
    directions = torch.nn.functional.normalize(torch.randn((300, 3), generator=generator).double(), dim=-1)
    rays = GRID.rays(origins, directions)
    crossing = rays.far > rays.near
    assert 0.1 < float(crossing.double().mean()) < 0.9
    middle, beyond = (rays.near + rays.far) / 2, rays.far + 1e-6
    within, outside = (rays.at(x[:, None])[crossing, 0] for x in (middle, beyond))
    assert bool(GRID.contains(within).all())
    assert not bool(GRID.contains(outside).any())


def test_a_mask_holds_what_its_cells_say_and_is_saved_with_them(generator: Generator) -> None:
    mask = OccupancyMask(GRID)
    assert bool(mask.holds(10 * torch.randn((100, 3), generator=generator)).all())
    mask.cells.copy_(torch.rand(GRID.shape, generator=generator) < 0.3)
    assert torch.equal(mask.holds(cell_centres(GRID)), mask.cells)
    assert list(mask.state_dict()) == ["cells"]
    again = OccupancyMask(GRID)
    again.load_state_dict(mask.state_dict())
    assert torch.equal(again.cells, mask.cells)
