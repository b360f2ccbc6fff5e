"""Rays on a baked surface: where they meet it, and how closely they pass by."""

from __future__ import annotations

import pytest
import torch
from torch import Generator

import baked
from bidnerf_core.mapping import cast, trace


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
    assert (
        float(torch.linalg.vector_norm(touched - aims, dim=-1).max())
        < 2 * surface.surfel_radius + surface.cell
    )


def test_what_passes_by_is_told_where_and_of_what() -> None:
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
