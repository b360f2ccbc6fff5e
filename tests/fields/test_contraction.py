"""Laws of the contraction of space, and of the coordinate along rays that goes with it."""

import pytest
import torch

from bidnerf_core.fields import RaySpacing, SceneBounds, VoxelGrid, contract_points

OPEN = SceneBounds((-1.0, -2.0, 0.5), (2.0, 1.0, 3.0), 0.1, 400.0, contracted=True)


def points(scale: float, count: int = 2000) -> torch.Tensor:
    return torch.randn(count, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1)) * scale


@pytest.mark.parametrize("scale", [0.1, 1.0, 30.0, 1e6])
def test_contraction_is_inverted_and_bounded(scale: float) -> None:
    """Its inverse multiplies each point by a number, which is 1 for near points, so directions stay the same."""
    contracted = contract_points(points(scale))
    assert float(contracted.abs().max()) < 2
    norm = contracted.abs().amax(-1, keepdim=True).clamp(min=1)
    torch.testing.assert_close(contracted / (norm * (2 - norm)), points(scale), rtol=1e-7, atol=1e-12)


def test_contraction_has_the_derivative_that_differences_show() -> None:
    assert torch.autograd.gradcheck(contract_points, points(3.0, 40).requires_grad_())


@pytest.mark.parametrize("radius", [1.5, float("inf")])
def test_the_coordinate_along_rays_is_inverted_and_ascends(radius: float) -> None:
    spacing = RaySpacing(torch.tensor([0.0, 2.5], dtype=torch.float64), radius)
    distance = torch.linspace(0, 300, 4000, dtype=torch.float64).expand(2, -1)
    place = spacing.coordinate(distance)
    assert bool((place.diff(dim=-1) > 0).all())
    torch.testing.assert_close(spacing.distance(place), distance)


def test_the_coordinate_is_the_distance_in_the_box_and_slows_down_beyond() -> None:
    rays = OPEN.rays(torch.tensor([[0.5, -0.5, 1.75]]), torch.tensor([[1.0, 0.0, 0.0]]))
    spacing = OPEN.spacing(rays)
    assert float(spacing.exit[0]) == pytest.approx(1.5)
    place = spacing.coordinate(torch.tensor([[1.0, 1.5, 3.0, 1e6]]))
    torch.testing.assert_close(place, torch.tensor([[1.0, 1.5, 2.25, 3.0]]), rtol=1e-5, atol=1e-5)


def test_equal_steps_of_the_coordinate_are_equal_steps_of_contracted_space() -> None:
    rays = OPEN.rays(torch.tensor([[0.5, -0.5, 1.75]]), torch.tensor([[0.0, 1.0, 0.0]]))
    spacing = OPEN.spacing(rays)
    limits = spacing.coordinate(torch.stack([rays.near, rays.far], -1))
    steps = torch.linspace(float(limits[0, 0]), float(limits[0, 1]), 100)[None]
    moved = OPEN.normalized(rays.at(spacing.distance(steps))).diff(dim=-2).norm(dim=-1)
    torch.testing.assert_close(moved, moved.mean().expand_as(moved), rtol=1e-2, atol=1e-6)


def test_an_open_scene_limits_rays_by_distance_alone() -> None:
    away = OPEN.rays(torch.tensor([[50.0, 0.0, 0.0]]), torch.tensor([[1.0, 0.0, 0.0]]))
    assert (float(away.near[0]), float(away.far[0])) == pytest.approx((OPEN.near, OPEN.far))


def test_all_space_is_in_the_grid_of_an_open_scene() -> None:
    grid = VoxelGrid.cube(OPEN, 16)
    far = points(1000.0).float()
    assert bool(grid.contains(far).all())
    centre = torch.tensor([OPEN.centre])
    assert int(grid.numbers(centre)) == (8 * 16 + 8) * 16 + 8
    middle = grid.numbers(centre + torch.tensor([[0.99, 0.99, 0.99]]) * OPEN.side / 2)
    assert int(middle) == (11 * 16 + 11) * 16 + 11  # the box fills the inner half
