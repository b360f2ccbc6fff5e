"""Half-lines and rays on a baked surface: where they meet it, and how closely they pass by; the extent of the scene."""

from __future__ import annotations

import pytest
import torch
from torch import Generator, Tensor

import baked
from bidnerf.scenes import Primitive, Shape, ball, blotches, box
from bidnerf_core.geometry import SE3
from bidnerf_core.mapping import SurfaceMap, cast, trace


def rays(count: int, generator: Generator) -> tuple[torch.Tensor, torch.Tensor]:
    """Return rays from all around towards the neighbourhood of the middle."""
    origins = 3 * torch.nn.functional.normalize(torch.randn((count, 3), generator=generator), dim=-1)
    aims = torch.randn((count, 3), generator=generator)
    return origins, torch.nn.functional.normalize(aims - origins, dim=-1)


def test_a_square_is_met_where_a_plane_is(generator: Generator) -> None:
    surface = baked.patch()
    aims = torch.cat([torch.rand((50, 2), generator=generator) * 0.8 - 0.4, torch.full((50, 1), 0.05)], -1)
    origins = aims + torch.randn((50, 3), generator=generator) * 0.2 + torch.tensor([0.0, 0.0, 2.0])
    length = torch.linalg.vector_norm(aims - origins, dim=-1)
    found = cast(surface, origins, (aims - origins) / length[:, None])
    assert bool(found.met.all())
    assert float((found.along - length).abs().max()) < 1.5 * surface.surfel_radius
    touched = surface.surfels.positions[found.index]
    assert float(torch.linalg.vector_norm(touched - aims, dim=-1).max()) < 2 * surface.surfel_radius + surface.cell


def test_a_ray_that_misses_ends_at_its_closest_point() -> None:
    """Along x, half a metre above the square: closest to its near edge as an angle, from 2 m before it."""
    surface = baked.patch()
    found = cast(surface, torch.tensor([[-2.5, 0.02, 0.55]]), torch.tensor([[1.0, 0.0, 0.0]]))
    assert not bool(found.met[0])
    position = surface.surfels.positions[found.index[0]]
    assert abs(float(position[1])) < 0.1
    assert 2.0 <= float(found.along[0]) <= 3.5


def test_beside_the_grid_and_behind_the_camera() -> None:
    origins = torch.tensor([[5.0, 0.0, 0.0], [5.0, 0.0, 0.0]])
    directions = torch.tensor([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    found = cast(baked.patch(), origins, directions)
    assert not bool(found.met.any())
    assert found.along.tolist() == pytest.approx([0.0, 0.0])


def test_it_meets_what_a_trace_meets(generator: Generator) -> None:
    surface = baked.toy()
    origins, directions = rays(400, generator)
    traced, found = trace(surface, origins, directions), cast(surface, origins, directions)
    both = traced.isfinite() & found.met
    assert int(both.sum()) > 50
    assert float((traced.isfinite() == found.met).float().mean()) > 0.95  # they do not reach equally far
    assert float((traced - found.along)[both].abs().median()) < surface.cell


def test_many_as_one_by_one_and_none(generator: Generator) -> None:
    surface = baked.toy()
    origins, directions = rays(20, generator)
    together = cast(surface, origins, directions)
    for i in range(20):
        alone = cast(surface, origins[i : i + 1], directions[i : i + 1])
        assert torch.equal(alone.along[0], together.along[i])
        assert torch.equal(alone.index[0], together.index[i])
    assert len(cast(surface, origins[:0], directions[:0]).met) == 0


PAINT = blotches((0.9, 0.2, 0.1), (0.1, 0.3, 0.8), 0.5, 1)


def test_beyond_the_grid_its_border_counts(generator: Generator) -> None:
    surface = baked.toy()
    far = 100 * torch.randn((300, 3), generator=generator)
    outside = far[(far.abs() > 1).any(-1)]
    assert torch.equal(surface.nearest(outside), surface.nearest(outside.clamp(-1, 1)))
    assert surface.nearest(outside[:60].reshape(3, 20, 3)).shape == (3, 20)


def solid(shape: Shape) -> tuple[SurfaceMap, Primitive]:
    return baked.baked(baked.one_solid(shape, PAINT), 40), Primitive(shape, SE3.identity(), PAINT)


def towards(targets: Tensor, generator: Generator) -> tuple[Tensor, Tensor]:
    origins = 3 * torch.nn.functional.normalize(torch.randn(targets.shape, generator=generator), dim=-1)
    origins[:, 2] = origins[:, 2].abs()  # the views are from above
    return origins, torch.nn.functional.normalize(targets - origins, dim=-1)


@pytest.mark.parametrize("shape", [ball(0.6), box((0.5, 0.4, 0.6))], ids=["sphere", "box"])
def test_half_lines_meet_the_surface_where_the_solid_is(shape: Shape, generator: Generator) -> None:
    surface, truth = solid(shape)
    origins, directions = towards(0.6 * torch.rand((400, 3), generator=generator) - 0.3, generator)
    found = trace(surface, origins, directions)
    expected = truth.distance(origins.T.contiguous(), directions.T.contiguous())
    assert (found - expected).abs().median() < surface.cell
    assert (found - expected).abs().quantile(0.98) < 3 * surface.cell  # grazing ones meet it early


def test_half_lines_that_miss_meet_nothing(generator: Generator) -> None:
    surface, _ = solid(ball(0.4))
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
