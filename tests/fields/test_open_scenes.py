"""Scenes with matter beyond their box: what every bundled backend does there, and what training learns of it."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

import tiny
from bidnerf.testing import SCENE_BOUNDS as BOUNDS
from bidnerf.testing import check_intervals, check_repeatable, rgb_views
from bidnerf_core.carving import occupied_voxels
from bidnerf_core.fields import RadianceField, Rays, VoxelGrid, levels, render
from bidnerf_core.training import Silent
from bidnerf_hashgrid import backend as hashgrid
from bidnerf_hashgrid.occupancy import OccupancyGrid
from optional import require
from small_backends import BACKENDS

OPEN = replace(BOUNDS, far=200.0, contracted=True, background=(0.0, 0.0, 0.0))


def built(name: str) -> RadianceField:
    backend, config = BACKENDS[name]
    field: RadianceField = backend.build(config, OPEN)
    return field


def outward(count: int = 400) -> Rays:
    """Rays from within the box into all directions."""
    directions = torch.randn(count, 3, generator=torch.Generator().manual_seed(4))
    directions = torch.nn.functional.normalize(directions, dim=-1)
    return OPEN.rays(torch.tensor(OPEN.centre).expand_as(directions), directions)


@pytest.mark.parametrize("name", BACKENDS)
def test_samplers_keep_the_contract_in_an_open_scene(name: str) -> None:
    for level in levels(built(name)):
        check_intervals(level)
        check_repeatable(level)


@pytest.mark.parametrize("name", ["hashgrid", "vanilla"])
def test_samples_of_an_untrained_field_cover_rays_as_far_as_they_go(name: str) -> None:
    rays = outward()
    samples = levels(built(name))[0].sampler(rays)
    length = torch.where(samples.valid, samples.ends - samples.starts, 0).sum(-1)
    assert float((length / (rays.far - rays.near) - 1).abs().median()) < 0.1
    ends = torch.where(samples.valid, samples.ends, 0).amax(-1)
    assert float(ends.median()) > 0.9 * OPEN.far


@pytest.mark.parametrize("name", BACKENDS)
def test_values_far_away_are_finite_and_have_derivatives(name: str) -> None:
    away = (outward(50).directions * torch.logspace(-2, 6, 50)[:, None]).requires_grad_()
    values = built(name).query(away, outward(50).directions)
    (values.density.sum() + values.rgb.sum()).backward()
    assert bool(values.density.isfinite().all())
    assert bool(values.rgb.isfinite().all())
    assert bool(require(away.grad).isfinite().all())


def test_an_occupancy_grid_of_contracted_space_samples_its_occupied_cells_only() -> None:
    grid, rays = OccupancyGrid(OPEN, 16), outward()
    cells = torch.rand(grid.grid.shape, generator=torch.Generator().manual_seed(8)) < 0.3
    grid.peak.copy_(cells)
    grid.prune(0.5, grow=False)
    samples = grid(rays)
    at = rays.at(samples.middles)
    # Within an interval the coordinate is not linear: its middle may lie in the cell beside that of the coordinate's.
    place = OPEN.spacing(rays).coordinate
    middle = OPEN.spacing(rays).distance((place(samples.starts) + place(samples.ends)) / 2)
    inner = samples.valid & ((samples.ends - samples.starts) > 0)
    inner &= (samples.starts > rays.near[:, None] + 1e-3) & (samples.ends < rays.far[:, None] * 0.99)
    found = grid.grid.at(cells, rays.at(middle))[inner]
    assert float(found.float().mean()) > 0.99
    assert float(grid.grid.at(cells, at)[inner].float().mean()) > 0.9
    # In the coordinate that is divided evenly: in metres, the last cell is as long as all others together.
    near, far = place(torch.stack([rays.near, rays.far], dim=-1)).unbind(-1)
    steps = near[:, None] + (far - near)[:, None] * (torch.arange(4000) + 0.5) / 4000
    every = grid.grid.at(cells, rays.at(OPEN.spacing(rays).distance(steps)))
    length = torch.where(samples.valid, place(samples.ends) - place(samples.starts), 0).sum(-1)
    expected = every.float().mean(-1) * (far - near)
    assert float(((length - expected).abs() / (far - near)).mean()) < 0.05


def test_only_the_inner_half_of_contracted_space_is_carved() -> None:
    views = list(tiny.views())
    grid = VoxelGrid.cube(OPEN, 32)
    judged, plain = occupied_voxels(views, grid), VoxelGrid.cube(replace(OPEN, contracted=False), 16)
    inner = torch.zeros(grid.shape, dtype=torch.bool)
    inner[8:24, 8:24, 8:24] = True
    assert bool(judged[~inner].all())
    assert torch.equal(judged[inner].view(16, 16, 16), occupied_voxels(views, plain))
    assert float(judged[inner].float().mean()) < 0.8


@pytest.mark.slow
def test_training_learns_what_lies_beyond_the_box() -> None:
    """Photos of a toy before white, without alpha: rays past the box become white, though the background is black.

    Where space ends at the box, no step can change what they see.
    """
    config = tiny.config(samples_per_step=4096, carve=False)
    pixel = torch.tensor([0.5, 0.5], dtype=torch.float64)
    rays = [view.T_ref_camera.rotate(view.frame.intrinsics.unproject(pixel)) for view in rgb_views()]
    corners = torch.nn.functional.normalize(torch.stack(rays), dim=-1).float()
    places = torch.stack([view.T_ref_camera.translation for view in rgb_views()]).float()
    seen = []
    for bounds, steps in ((OPEN, 150), (replace(OPEN, contracted=False), 8)):
        field = hashgrid.build(config, bounds)
        hashgrid.train(field, rgb_views(), replace(config, steps=steps), Silent())
        with torch.no_grad():
            seen.append(render(field, bounds.rays(places, corners), torch.zeros(3)).rgb)
    assert float(seen[0].min()) > 0.75
    assert float(seen[1].max()) == 0
