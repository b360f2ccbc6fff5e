"""What a rendering is judged by: colour, depth, and matter where a sensor saw through."""

from __future__ import annotations

import pytest
import torch

from bidnerf_core.field import Rays, RaySamples, SceneBounds
from bidnerf_core.localization import BidConfig
from bidnerf_core.observations import Observations
from bidnerf_core.rendering import Rendering, render
from bidnerf_core.residuals import Objective, depth, free_space, masked_mean, objective
from bidnerf_core.robust import Robust
from bidnerf_core.scenes.fields import GaussianBlobs

BOUNDS = SceneBounds((-2.0, -2.0, -2.0), (2.0, 2.0, 2.0), 0.1, 12.0)
L2, HUBER = Robust("l2", 0.1), Robust("huber", 0.1)


def wall(at: float, opacity: float = 1.0) -> Rendering:
    """Two views of three rays each; all weight in one sample."""
    shape = (2, 3)
    middle = torch.full((*shape, 1), at)
    samples = RaySamples(middle, middle, torch.ones(*shape, 1, dtype=torch.bool))
    seen = torch.full(shape, opacity)
    return Rendering(torch.full((*shape, 3), 0.5), seen * at, seen, seen[..., None], samples)


def measured(distance: torch.Tensor) -> Observations:
    zero = torch.zeros(2, 3, 3)
    return Observations(zero, zero, torch.full((2, 3, 3), 0.5), distance, distance > -1)


def test_free_space_counts_what_is_in_front_and_nothing_else() -> None:
    distance = torch.full((2, 3), 2.0)
    distance[0, 0] = 0
    in_front = free_space(wall(1.2), distance, 0.1)
    torch.testing.assert_close(in_front, torch.where(distance > 0, 0.7, 0.0))
    torch.testing.assert_close(free_space(wall(1.2, 0.5), distance, 0.1), 0.5 * in_front)
    for at in (1.95, 2.0, 5.0):
        assert float(free_space(wall(at), distance, 0.1).abs().max()) == 0


def test_matter_on_both_sides_is_told_from_a_surface() -> None:
    """Half of the weight before, half behind: the mean depth is right, and only free space objects."""
    middles = torch.tensor([1.0, 3.0]).expand(2, 3, 2)
    weights = torch.full((2, 3, 2), 0.5)
    samples = RaySamples(middles, middles, torch.ones(2, 3, 2, dtype=torch.bool))
    both = Rendering(torch.full((2, 3, 3), 0.5), torch.full((2, 3), 2.0), torch.ones(2, 3), weights, samples)
    pixels = measured(torch.full((2, 3), 2.0))
    assert float(Objective(L2, HUBER, 1.0)(both, pixels)) == 0
    assert float(Objective(L2, HUBER, 1.0, free_space_weight=1.0)(both, pixels)) > 0.01


def test_the_derivative_by_the_rays_is_the_numerical_one() -> None:
    generator = torch.Generator().manual_seed(0)
    origins = torch.tensor([[0.0, 0.0, -3.5]], dtype=torch.float64).expand(12, 3)
    aims = 0.6 * torch.randn((12, 3), generator=generator, dtype=torch.float64)
    directions = torch.nn.functional.normalize(aims - origins, dim=-1)
    field, here = GaussianBlobs.random(), BOUNDS.rays(origins, directions)
    probe = Observations.of_depth(origins, directions, torch.full((12,), 4.2, dtype=torch.float64))
    judged = Objective(L2, Robust("cauchy", 0.1), 0.0, free_space_weight=1.0)

    def loss(shift: torch.Tensor) -> torch.Tensor:
        rays = Rays(origins + shift, directions, here.near, here.far)  # where to look is held
        return judged.on_depth_rays(render(field, rays), probe)

    zero = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    assert float(loss(zero).detach()) > 1e-3
    assert torch.autograd.gradcheck(loss, zero, eps=1e-6, atol=1e-7)


def test_views_count_alike_however_many_of_their_pixels_were_measured() -> None:
    """Eq. 6: the mean over views of their means over measured rays."""
    distance = torch.tensor([[2.0, 0.0, 0.0], [2.0, 2.0, 2.0]])
    found = Objective(L2, L2, 1.0)(wall(2.4), measured(distance))
    assert float(found) == pytest.approx(0.5 * 0.4**2)
    assert float(Objective(L2, L2, 1.0)(wall(2.4), measured(torch.zeros(2, 3)))) == 0
    torch.testing.assert_close(
        masked_mean(depth(wall(2.4), measured(distance)), distance > 0), torch.tensor([0.4, 0.4])
    )


def test_the_papers_objective_is_hubers_for_both() -> None:
    distance = torch.tensor([[2.0, 0.0, 0.0], [2.0, 2.0, 2.0]])
    assert objective(wall(2.4), measured(distance), 0.1, 1.0) == BidConfig().objective(
        wall(2.4), measured(distance)
    )
    assert float(objective(wall(2.4), measured(distance), 0.1, 1.0)) == pytest.approx(0.1 * (0.4 - 0.05))


def test_weight_zero_heeds_no_depth() -> None:
    assert not Objective(L2, L2, 0.0).heeds_depth
    assert Objective(L2, L2, 0.0, free_space_weight=0.1).heeds_depth
    assert float(Objective(L2, L2, 0.0)(wall(9.0), measured(torch.full((2, 3), 2.0)))) == 0
