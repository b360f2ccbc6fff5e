"""Surfels know the plane and the colours about them."""

from __future__ import annotations

import pytest
import torch
from torch import Generator

from bidnerf_core.geometry import SE3
from bidnerf_core.mapping.surface.surface_map import fused_surfels, merged


def on_a_plane(generator: Generator, count: int = 400) -> tuple[torch.Tensor, torch.Tensor]:
    """Points of a plane, and its unit normal."""
    flat = torch.rand((count, 3), generator=generator) * torch.tensor([1.0, 1.0, 0.0])
    turn = SE3.exp(torch.tensor([0.3, -0.2, 0.1, 0.5, 0.7, -0.4]))
    return turn.apply(flat), turn.rotation[:, 2]


def test_a_plane_is_left_where_it_is_and_has_its_normal(generator: Generator) -> None:
    points, normal = on_a_plane(generator)
    surfels = fused_surfels(points, torch.rand((len(points), 3), generator=generator))
    assert len(surfels) == len(points)
    assert torch.allclose(surfels.positions, points, atol=1e-5)
    assert torch.allclose((surfels.normals @ normal).abs(), torch.ones(len(points)), atol=1e-4)


def test_a_sphere_has_radial_normals(generator: Generator) -> None:
    outward = torch.nn.functional.normalize(torch.randn((4000, 3), generator=generator), dim=-1)
    surfels = fused_surfels(2 * outward, outward)
    assert ((surfels.normals * outward).sum(-1).abs() > 0.99).float().mean() > 0.98


def test_noise_across_the_plane_is_averaged(generator: Generator) -> None:
    points, normal = on_a_plane(generator, 2000)
    noise = 0.005 * torch.randn((len(points), 1), generator=generator)
    smooth = fused_surfels(points + noise * normal, points).positions
    off = (smooth - points.mean(0)) @ normal
    assert off.std() < 0.5 * noise.std()


def test_a_linear_colour_has_its_gradient_within_the_plane(generator: Generator) -> None:
    points, normal = on_a_plane(generator)
    slope = torch.randn((3, 3), generator=generator)  # channel by axis
    surfels = fused_surfels(points, points @ slope.T)
    within = slope - (slope @ normal)[:, None] * normal
    error = torch.linalg.matrix_norm(surfels.rgb_gradient - within)
    assert error.median() < 0.06 * torch.linalg.matrix_norm(within)  # a little weight tames thin strips
    assert (surfels.rgb_gradient @ surfels.normals[..., None]).abs().max() < 1e-3


def test_one_colour_has_no_gradient(generator: Generator) -> None:
    points, _ = on_a_plane(generator)
    surfels = fused_surfels(points, torch.full((len(points), 3), 0.3))
    assert surfels.rgb_gradient.abs().max() < 1e-4
    assert torch.allclose(surfels.rgb, torch.tensor(0.3))


@pytest.mark.parametrize("count", [1, 2, 3, 11, 13])
def test_few_points_in_a_row_are_surfels_too(count: int) -> None:
    points = torch.arange(count)[:, None] * torch.tensor([0.1, 0.0, 0.0])
    surfels = fused_surfels(points, points)
    for value in (surfels.positions, surfels.normals, surfels.rgb, surfels.rgb_gradient):
        assert len(value) == count
        assert value.isfinite().all()
    assert torch.allclose(torch.linalg.vector_norm(surfels.normals, dim=-1), torch.ones(count))


def test_points_of_a_cell_become_their_mean(generator: Generator) -> None:
    cells = torch.randint(7, (50,), generator=generator) * 3
    points, weights = torch.rand((50, 3), generator=generator), torch.rand((50, 1), generator=generator)
    found, (means, others) = merged(cells, points, weights)
    assert found.tolist() == sorted(set(cells.tolist()))
    for cell, mean, other in zip(found, means, others, strict=True):
        assert torch.allclose(mean, points[cells == cell].mean(0))
        assert torch.allclose(other, weights[cells == cell].mean(0))
