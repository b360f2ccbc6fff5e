"""The nearest surfel of any point, and where half-lines meet the surface."""

from __future__ import annotations

import pytest
import torch
from scipy.spatial import cKDTree
from torch import Generator, Tensor

import baked
from bidnerf_core.geometry import SE3
from bidnerf_core.mapping import SurfaceMap, trace
from bidnerf_core.scenes import Box, Primitive, Shape, Sphere, blotches

PAINT = blotches((0.9, 0.2, 0.1), (0.1, 0.3, 0.8), 0.5, 1)


def test_the_nearest_surfel_is_found_to_within_a_cell(generator: Generator) -> None:
    surface = baked.toy()
    points = 1.8 * torch.rand((2000, 3), generator=generator) - 0.9
    least, _ = cKDTree(surface.surfels.positions.numpy()).query(points.numpy())
    found = surface.distance(points)
    assert (found >= torch.from_numpy(least).float() - 1e-5).all()
    assert (found <= torch.from_numpy(least).float() + 3**0.5 * 2 * surface.cell).all()


def test_beyond_the_grid_its_border_counts(generator: Generator) -> None:
    surface = baked.toy()
    far = 100 * torch.randn((300, 3), generator=generator)
    outside = far[(far.abs() > 1).any(-1)]
    assert torch.equal(surface.nearest(outside), surface.nearest(outside.clamp(-1, 1)))
    assert surface.nearest(outside[:60].reshape(3, 20, 3)).shape == (3, 20)


def solid(shape: Shape) -> tuple[SurfaceMap, Primitive]:
    scene = baked.one_solid(shape, PAINT)
    return baked.baked(scene, 40), Primitive(shape, SE3.identity(), PAINT)


def towards(targets: Tensor, generator: Generator) -> tuple[Tensor, Tensor]:
    origins = 3 * torch.nn.functional.normalize(torch.randn(targets.shape, generator=generator), dim=-1)
    origins[:, 2] = origins[:, 2].abs()  # the views are from above
    return origins, torch.nn.functional.normalize(targets - origins, dim=-1)


@pytest.mark.parametrize("shape", [Sphere(0.6), Box((0.5, 0.4, 0.6))], ids=["sphere", "box"])
def test_half_lines_meet_the_surface_where_the_solid_is(shape: Shape, generator: Generator) -> None:
    surface, truth = solid(shape)
    origins, directions = towards(0.6 * torch.rand((400, 3), generator=generator) - 0.3, generator)
    found = trace(surface, origins, directions)
    expected = truth.distance(origins.T.contiguous(), directions.T.contiguous())
    assert (found - expected).abs().median() < surface.cell
    assert (found - expected).abs().quantile(0.98) < 3 * surface.cell  # grazing ones meet it early


def test_half_lines_that_miss_meet_nothing(generator: Generator) -> None:
    surface, _ = solid(Sphere(0.4))
    origins, directions = towards(torch.zeros((50, 3)), generator)
    assert trace(surface, origins, -directions).isinf().all()  # behind
    across = torch.nn.functional.normalize(torch.linalg.cross(directions, origins.flip(-1)), dim=-1)
    assert trace(surface, origins, across).isinf().all()  # past the grid
    aside = torch.tensor([[-2.0, 0.8, 0.8]]), torch.tensor([[1.0, 0.0, 0.0]])
    assert trace(surface, *aside).isinf().all()  # through the grid, past the ball


def test_stray_surfels_do_not_enlarge_the_scene() -> None:
    inner = baked.patch(5)
    low, high = inner.box
    assert ((high - low) > torch.tensor([0.8, 0.8, -1.0])).all()
    strayed = torch.cat([inner.surfels.positions, torch.tensor([[0.05, 0.05, 0.95], [0.95, 0.95, 0.95]])])
    order = ((strayed + 1) / 0.1).floor().long() @ torch.tensor([400, 20, 1])
    outer = baked.of_points(strayed[order.argsort()], strayed[order.argsort()], (0.0, 0.0, 1.0))
    assert outer.extent == pytest.approx(inner.extent, rel=0.05)
