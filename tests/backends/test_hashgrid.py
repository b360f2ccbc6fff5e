"""The hash-grid field and its occupancy grid."""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace

import pytest
import torch
from torch import Tensor

import tiny
from bidnerf_core.fields import (
    FieldValues,
    Rays,
    RaySampler,
    SceneBounds,
    VoxelGrid,
    render,
)
from bidnerf_hashgrid import HashGridConfig, HashGridField, backend
from bidnerf_hashgrid.encoding import HashEncodingConfig
from bidnerf_hashgrid.occupancy import OccupancyGrid
from refusals import refused
from voxels import cell_centres, cells_of

BOUNDS = SceneBounds((-1.2, -0.4, 0.1), (0.8, 0.7, 1.3), 0.1, 8.0, (0.3, 0.6, 0.9))
RESOLUTION = 12

# The occupancy grid as a sampler.


def grid_of(occupied: Tensor, steps_per_cell: int = 2) -> OccupancyGrid:
    """Exactly these cells, and no margin about them."""
    grid = OccupancyGrid(BOUNDS, occupied.shape[0], steps_per_cell)
    grid.peak.copy_(occupied)
    grid.prune(0.5, grow=False)
    assert torch.equal(grid.occupied, occupied)
    return grid


def random_cells(share: float, seed: int) -> Tensor:
    return torch.rand((RESOLUTION,) * 3, generator=torch.Generator().manual_seed(seed)) < share


def random_rays(count: int = 300, seed: int = 0) -> Rays:
    """Float64, from outside and inside of the box, most but not all meeting it, some along the axes."""
    generator = torch.Generator().manual_seed(seed)
    origins = torch.randn((count, 3), generator=generator, dtype=torch.float64) * 1.5
    targets = torch.rand((count, 3), generator=generator, dtype=torch.float64) * 2 - 1
    directions = torch.nn.functional.normalize(targets - origins, dim=-1)
    directions[:9] = torch.eye(3, dtype=torch.float64).repeat(3, 1)
    directions[3:6] *= -1
    rays = BOUNDS.rays(origins, directions)
    assert 0.1 < (rays.far > rays.near).double().mean() < 1
    return rays


def marched(grid: OccupancyGrid, rays: Rays, offset: Tensor) -> list[Tensor]:
    """Distances of the occupied steps of each ray, found by looking at every one."""
    found = []
    for i in range(len(rays.near)):
        near, far = float(rays.near[i]), float(rays.far[i])
        steps = torch.arange(int(max(0.0, far - near) / grid.step) + 2, dtype=torch.float64)
        distance = near + (steps + offset[i]) * grid.step
        distance = distance[distance < far]
        positions = rays.origins[i] + distance[:, None] * rays.directions[i]
        found.append(distance[grid.occupied[cells_of(grid.grid, positions)]])
    return found


@pytest.mark.parametrize("steps_per_cell", [1, 2, 3])
@pytest.mark.parametrize("share", [0.0, 0.002, 0.03, 0.4, 1.0])
@pytest.mark.parametrize("jitter", [False, True])
def test_skipping_blocks_loses_no_sample(share: float, steps_per_cell: int, jitter: bool) -> None:
    grid, rays = grid_of(random_cells(share, seed=3), steps_per_cell), random_rays()
    offset, generator = torch.full_like(rays.near, 0.5), None
    if jitter:
        offset = torch.rand(rays.near.shape, generator=torch.Generator().manual_seed(7)).double()
        generator = torch.Generator().manual_seed(7)
    samples = grid(rays, generator)
    expected = marched(grid, rays, offset)
    assert torch.equal(samples.valid.sum(-1), torch.tensor([len(distances) for distances in expected]))
    half, near, far = grid.step / 2, rays.near[:, None], rays.far[:, None]
    every = torch.nn.utils.rnn.pad_sequence(expected, batch_first=True)
    torch.testing.assert_close(
        samples.starts[samples.valid], torch.maximum(every - half, near)[samples.valid], atol=1e-9, rtol=0
    )
    torch.testing.assert_close(
        samples.ends[samples.valid], torch.minimum(every + half, far)[samples.valid], atol=1e-9, rtol=0
    )


@dataclass(frozen=True, eq=False)
class Clouds:
    """Matter in the occupied cells of a grid, nothing elsewhere; another colour everywhere."""

    grid: OccupancyGrid
    sampler: RaySampler

    def query(self, positions: Tensor, directions: Tensor) -> FieldValues:
        inside = self.grid.occupied[cells_of(self.grid.grid, positions)]
        density = torch.where(inside, 4 + 3 * torch.sin(7 * positions).sum(-1), 0)
        return FieldValues(density.clamp(min=0), 0.5 + 0.5 * torch.sin(5 * positions))


@pytest.mark.parametrize("seed", range(3))
def test_leaving_out_empty_cells_changes_no_image(seed: int) -> None:
    cells = random_cells(0.4, seed)
    centres, margin = cell_centres(VoxelGrid.cube(BOUNDS, RESOLUTION)), max(BOUNDS.size) / RESOLUTION
    lower, upper = torch.tensor(BOUNDS.lower) + margin, torch.tensor(BOUNDS.upper) - margin
    cells &= ((centres > lower) & (centres < upper)).all(-1)  # what the limits cut short is at the border
    sparse, full, rays = grid_of(cells), grid_of(torch.ones_like(cells)), random_rays(600)
    outside = rays.near > BOUNDS.near
    rays = Rays(rays.origins[outside], rays.directions[outside], rays.near[outside], rays.far[outside])
    jitter = torch.Generator().manual_seed(seed)
    state = jitter.get_state()
    found = render(Clouds(sparse, sparse), rays, BOUNDS.background, jitter)
    jitter.set_state(state)
    expected = render(Clouds(sparse, full), rays, BOUNDS.background, jitter)
    assert found.samples.valid.sum() < 0.4 * expected.samples.valid.sum()
    assert 0.1 < expected.opacity.mean() < 0.9
    for name in ("rgb", "distance", "opacity"):
        torch.testing.assert_close(getattr(found, name), getattr(expected, name), atol=1e-9, rtol=1e-9)


# What the grid takes note of.


def test_peaks_rise_at_once_fade_when_visited_and_stay_when_not() -> None:
    grid = grid_of(torch.zeros((RESOLUTION,) * 3, dtype=torch.bool))
    grid.peak.fill_(0.5)
    here, there = cell_centres(grid.grid)[[3, 6], [4, 7], [5, 8]]
    weights, densities = torch.tensor([0.1, 0.9, 0.2, 0.0]), torch.tensor([3.0, 8.0, 2.0, 1.0])
    grid.observe(torch.stack([here, there, here, here]), weights, densities, fade=0.8)
    assert float(grid.density[3, 4, 5]) == 3
    assert float(grid.density[6, 7, 8]) == 8
    assert int((grid.density != 0).sum()) == 2
    assert float(grid.peak[3, 4, 5]) == pytest.approx(0.4)
    assert float(grid.peak[6, 7, 8]) == pytest.approx(0.9)
    assert int((grid.peak != 0.5).sum()) == 2
    grid.observe(here[None], torch.tensor([0.35]), torch.ones(1), fade=0.8)
    assert float(grid.density[3, 4, 5]) == pytest.approx(2.4)
    assert float(grid.peak[3, 4, 5]) == pytest.approx(0.35)
    before = grid.peak.clone()
    grid.observe(torch.zeros(0, 3), torch.zeros(0), torch.zeros(0), fade=0.8)
    assert torch.equal(grid.peak, before)


def test_pruning_keeps_what_has_weight_and_its_neighbours_while_surfaces_may_move() -> None:
    grid = OccupancyGrid(BOUNDS, RESOLUTION)
    grid.peak.zero_()
    grid.peak[0, 5, 11] = 0.3
    grid.peak[6, 6, 6] = 0.1
    grid.prune(0.2, grow=False)
    assert grid.occupied.nonzero().tolist() == [[0, 5, 11]]
    grid.prune(0.2)
    near = (grid.occupied.nonzero() - torch.tensor([0, 5, 11])).abs()
    assert len(near) == 2 * 3 * 2  # at a border on two sides
    assert int(near.max()) == 1
    grid.prune(0.3)
    assert not grid.occupied.any()
    assert not grid.near_occupied.any()


def test_restricting_empties_what_is_not_allowed_for_good() -> None:
    grid = OccupancyGrid(BOUNDS, RESOLUTION)
    allowed = torch.zeros((RESOLUTION,) * 3, dtype=torch.bool)
    allowed[2:5, 3:6, 4:7] = True
    grid.restrict(allowed)
    assert torch.equal(grid.peak > 0, allowed)
    margin = torch.zeros_like(allowed)
    margin[1:6, 2:7, 3:8] = True
    assert torch.equal(grid.occupied, margin)
    grid.prune(0.01)
    assert torch.equal(grid.occupied, margin)


def test_what_is_derived_from_the_occupancy_is_brought_up_to_date_on_loading() -> None:
    sparse, fresh = grid_of(random_cells(0.01, seed=0)), OccupancyGrid(BOUNDS, RESOLUTION)
    fresh.load_state_dict(sparse.state_dict())
    assert torch.equal(fresh.near_occupied, sparse.near_occupied)
    assert not fresh.near_occupied.all()


# The field.


def test_settings_that_make_no_sense_are_refused() -> None:
    with refused(found="coarse_levels is 99", expected="10 (levels of the encoding) or less"):
        HashGridConfig(coarse_levels=99)
    with refused(found="learning_rate is 0", expected="more than 0"):
        HashGridConfig(learning_rate=0)


@pytest.fixture(scope="module")
def field() -> HashGridField:
    """Float64, with features and density of order one, and with more detail at finer levels."""
    config = tiny.config(encoding=HashEncodingConfig(4, 2, 9, 4, 32), coarse_levels=2)
    made = backend.build(config, BOUNDS).double()
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for table in made.encoding.tables:
            table.copy_(torch.randn(table.shape, generator=generator, dtype=torch.float64))
    return made


def random_points(shape: tuple[int, ...], seed: int = 0) -> tuple[Tensor, Tensor]:
    """Positions in the box, and directions."""
    generator = torch.Generator().manual_seed(seed)
    lower, size = torch.tensor(BOUNDS.lower), torch.tensor(BOUNDS.size)
    positions = (lower + size * torch.rand((*shape, 3), generator=generator)).double()
    directions = torch.randn((*shape, 3), generator=generator, dtype=torch.float64)
    return positions, torch.nn.functional.normalize(directions, dim=-1)


def test_density_is_finite_whatever_the_network_says(field: HashGridField) -> None:
    wild = copy.deepcopy(field)
    with torch.no_grad():
        for parameter in wild.geometry.parameters():
            parameter.mul_(1e6)
    values = wild.query(*random_points((200,)))
    assert bool(values.density.isfinite().all())
    assert bool((values.density >= 0).all())


@pytest.mark.parametrize("level", [0, 1])
def test_derivatives_by_position_and_direction_are_the_slopes(level: int, field: HashGridField) -> None:
    mix = torch.tensor([1.0, 2.0, -1.5], dtype=torch.float64)

    def value(positions: Tensor, directions: Tensor) -> Tensor:
        found = field.levels[level].query(positions, directions)
        return torch.log1p(found.density) + found.rgb @ mix

    points = [part.requires_grad_() for part in random_points((40,), seed=1)]
    assert torch.autograd.gradcheck(value, points, eps=1e-7, atol=1e-5, rtol=1e-5)
    assert all(float(x.abs().mean()) > 1e-2 for x in torch.autograd.grad(value(*points).sum(), points))


def test_the_coarse_level_does_not_see_the_fine_tables(field: HashGridField) -> None:
    points = random_points((50,))
    other = copy.deepcopy(field)
    with torch.no_grad():
        for table in list(other.encoding.tables)[field.config.coarse_levels :]:
            table.neg_()
    assert torch.equal(other.levels[0].query(*points).density, field.levels[0].query(*points).density)
    assert not torch.allclose(other.query(*points).density, field.query(*points).density)
    loss = other.levels[0].query(*points).density.sum()
    gradients = torch.autograd.grad(loss, list(other.encoding.tables), allow_unused=True)
    assert [gradient is None for gradient in gradients] == [False, False, True, True]


def test_a_ray_has_no_more_samples_than_the_limit_once_density_was_observed(field: HashGridField) -> None:
    """The intervals of rays that cross few occupied cells stay what they are; those of others keep their total length."""
    limited = backend.build(replace(field.config, samples_per_ray=12), BOUNDS)
    for level in limited.levels:
        assert level.sampler is level.occupancy
    limited.occupancy.restrict(
        torch.rand(limited.occupancy.grid.shape, generator=torch.Generator().manual_seed(0)) < 0.6
    )
    limited.occupancy.observe(torch.zeros(1, 3), torch.ones(1), torch.ones(1), fade=1.0)
    rays = limited.bounds.rays(*(getattr(random_rays(), part).float() for part in ("origins", "directions")))
    every, some = limited.occupancy(rays), limited.sampler(rays)
    counts = every.valid.sum(-1)
    few = counts <= 12
    assert bool(few.any())
    assert bool((~few).any())
    assert torch.equal(some.valid.sum(-1), counts.clamp(max=12))
    assert torch.equal(some.starts[few], every.starts[few][:, :12])
    length, expected = (((s.ends - s.starts) * s.valid).sum(-1) for s in (some, every))
    torch.testing.assert_close(length[~few], expected[~few], atol=1e-4, rtol=1e-4)


def test_the_limit_holds_from_the_beginning_where_the_scene_is_contracted(field: HashGridField) -> None:
    opened = backend.build(replace(field.config, samples_per_ray=12), replace(BOUNDS, far=90.0, contracted=True))
    rays = opened.bounds.rays(*(getattr(random_rays(), part).float() for part in ("origins", "directions")))
    for level in opened.levels:
        assert int(level.occupancy(rays).valid.sum(-1).max()) > 12
        assert int(level.sampler(rays).valid.sum(-1).max()) <= 12


def test_a_state_with_infinite_densities_is_refused(field: HashGridField) -> None:
    state = {name: value.clone() for name, value in field.state_dict().items()}
    state["coarse_sampler.density"].view(-1)[3] = torch.inf
    with refused(found="tensor 'coarse_sampler.density' holds infinity", expected="densities"):
        field.upgraded_state(state)
