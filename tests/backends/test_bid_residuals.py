"""Residuals and objectives: colour, depth, silhouettes, matter in free space, and one objective for both kinds of solver."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from bidnerf.scenes import GaussianBlobs
from bidnerf_bid import DEPTH_RESIDUALS, BidConfig, DepthSettings, Objective, objective_of
from bidnerf_bid.residuals import depth_residual, free_space, masked_mean
from bidnerf_core.fields import Observations, Rays, RaySamples, Rendering, SceneBounds, render
from bidnerf_core.geometry import RobustName
from bidnerf_core.localization import METHODS, ColourSettings

BOUNDS = SceneBounds((-2.0, -2.0, -2.0), (2.0, 2.0, 2.0), 0.1, 12.0)


def objective(colour: RobustName, depth: RobustName, depth_weight: float, free_space_weight: float = 0.0) -> Objective:
    """Return the objective of robust losses with a scale of 0.1."""
    settings = DepthSettings(depth_weight, depth, 0.1, free_space_weight=free_space_weight)
    return objective_of(ColourSettings(colour, 0.1), settings)


def wall(at: float, opacity: float = 1.0) -> Rendering:
    """Return two views of three rays each; all weight in one sample."""
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


def test_matter_on_both_sides_is_distinguished_from_a_surface() -> None:
    """Half of the weight before, half behind: the mean depth is right, and only the free-space term rejects it."""
    middles = torch.tensor([1.0, 3.0]).expand(2, 3, 2)
    weights = torch.full((2, 3, 2), 0.5)
    samples = RaySamples(middles, middles, torch.ones(2, 3, 2, dtype=torch.bool))
    both = Rendering(torch.full((2, 3, 3), 0.5), torch.full((2, 3), 2.0), torch.ones(2, 3), weights, samples)
    pixels = measured(torch.full((2, 3), 2.0))
    assert float(objective("l2", "huber", 1.0).loss(both, pixels)) == 0
    assert float(objective("l2", "huber", 1.0, free_space_weight=1.0).loss(both, pixels)) > 0.01


def test_the_derivative_by_the_rays_is_the_numerical_one() -> None:
    generator = torch.Generator().manual_seed(0)
    origins = torch.tensor([[0.0, 0.0, -3.5]], dtype=torch.float64).expand(12, 3)
    aims = 0.6 * torch.randn((12, 3), generator=generator, dtype=torch.float64)
    directions = torch.nn.functional.normalize(aims - origins, dim=-1)
    field, here = GaussianBlobs.random(), BOUNDS.rays(origins, directions)
    probe = Observations.of_depth(origins, directions, torch.full((12,), 4.2, dtype=torch.float64))
    in_front = objective("l2", "cauchy", 0.0, free_space_weight=1.0)

    def loss(shift: torch.Tensor) -> torch.Tensor:
        rays = Rays((origins + shift)[None], directions[None], here.near[None], here.far[None])
        return in_front.loss(render(field, rays), probe[None])

    zero = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    assert float(loss(zero).detach()) > 1e-3
    assert torch.autograd.gradcheck(loss, zero, eps=1e-6, atol=1e-7)


def test_views_count_alike_however_many_of_their_pixels_were_measured() -> None:
    """Eq. 6: the mean over views of their means over measured rays."""
    distance = torch.tensor([[2.0, 0.0, 0.0], [2.0, 2.0, 2.0]])
    found = objective("l2", "l2", 1.0).loss(wall(2.4), measured(distance))
    assert float(found) == pytest.approx(0.5 * 0.4**2)
    assert float(objective("l2", "l2", 1.0).loss(wall(2.4), measured(torch.zeros(2, 3)))) == 0
    torch.testing.assert_close(
        masked_mean(depth_residual(wall(2.4), measured(distance)), distance > 0), torch.tensor([0.4, 0.4])
    )


def test_the_papers_objective_has_hubers_loss_for_both() -> None:
    """Eq. 5 with ``rho(r) = delta (r - delta / 2)`` for depths that are 0.4 m off, and colours that agree."""
    distance = torch.tensor([[2.0, 0.0, 0.0], [2.0, 2.0, 2.0]])
    default = objective_of(BidConfig().colour, METHODS["bid"].settings("paper").depth)
    assert float(default.loss(wall(2.4), measured(distance))) == pytest.approx(0.1 * (0.4 - 0.05))


def test_weight_zero_uses_no_depth() -> None:
    assert not objective("l2", "l2", 0.0).uses_depth
    assert objective("l2", "l2", 0.0, free_space_weight=0.1).uses_depth
    assert float(objective("l2", "l2", 0.0).loss(wall(9.0), measured(torch.full((2, 3), 2.0)))) == 0


SOME = torch.tensor([[2.0, 0.0, 0.0], [2.0, 2.0, 2.0]])


def test_a_depth_residual_of_ones_own_is_named_by_a_setting(monkeypatch: pytest.MonkeyPatch) -> None:
    def halved(rendering: Rendering, observed: Observations) -> torch.Tensor:
        return (rendering.distance - observed.distance) / 2

    monkeypatch.setitem(DEPTH_RESIDUALS, "halved", halved)
    found = objective_of(ColourSettings(), DepthSettings(depth_scale=0.1, depth_residual="halved"))
    pixels = measured(SOME)
    torch.testing.assert_close(
        found.terms[1].residual(wall(2.4), pixels)[..., 0], torch.where(SOME > 0, torch.tensor(0.2), 0.0)
    )


def pixel_at(distance: float) -> Observations:
    """Return a ray of the colour that is rendered, with a distance (metres; 0: none)."""
    zero = torch.zeros((1, 3), dtype=torch.float64)
    far = torch.full((1,), distance, dtype=torch.float64)
    return Observations(zero, zero, zero, far, torch.ones(1, dtype=torch.bool))


def silhouette(share: float, distance: float = 2.0, behind: float = 6.0) -> Rendering:
    """Return a rendering of one ray with ``share`` of its weight at ``distance``, and the rest far behind; metres."""
    middles = torch.tensor([[distance, behind]], dtype=torch.float64)
    weights = torch.tensor([[share, 1 - share]], dtype=torch.float64)
    samples = RaySamples(middles, middles, torch.ones(1, 2, dtype=torch.bool))
    return Rendering(
        torch.zeros((1, 3), dtype=torch.float64),
        (weights * middles).sum(-1),
        weights.sum(-1),
        weights,
        samples,
    )


def test_a_truncated_depth_error_bears_a_silhouette() -> None:
    """A tenth of the weight four metres behind: the mean distance is off by 0.4 m, the truncated one by a tenth of the limit."""
    pixel = pixel_at(2.0)
    rendering = silhouette(0.9)
    assert float(depth_residual(rendering, pixel)) == pytest.approx(0.4)
    assert float(DEPTH_RESIDUALS["truncated"](rendering, pixel)) == pytest.approx(0.03)
    passing = replace(rendering, weights=rendering.weights * 0, opacity=rendering.opacity * 0)
    assert float(DEPTH_RESIDUALS["truncated"](passing, pixel)) == pytest.approx(0.3)
    near = silhouette(1.0, 2.05)
    assert float(DEPTH_RESIDUALS["truncated"](near, pixel)) == pytest.approx(0.05)


def test_the_first_surface_is_compared_where_there_is_one() -> None:
    pixel = pixel_at(2.0)
    assert float(DEPTH_RESIDUALS["first-surface"](silhouette(0.9, 2.05), pixel)) == pytest.approx(0.05)
    assert float(DEPTH_RESIDUALS["first-surface"](silhouette(0.2), pixel)) == pytest.approx(
        4.0
    )  # the first one is glass
    empty = replace(silhouette(0.9), opacity=torch.zeros(1, dtype=torch.float64))
    assert float(DEPTH_RESIDUALS["first-surface"](empty, pixel)) == 0
    leaf = torch.tensor([[2.05, 6.0]], dtype=torch.float64).requires_grad_()
    samples = RaySamples(leaf, leaf, torch.ones(1, 2, dtype=torch.bool))
    rendering = replace(silhouette(0.9, 2.05), samples=samples)
    (slope,) = torch.autograd.grad(DEPTH_RESIDUALS["first-surface"](rendering, pixel).sum(), leaf)
    torch.testing.assert_close(slope, torch.tensor([[1.0, 0.0]], dtype=torch.float64))


def test_light_that_passes_through_matter_is_penalised() -> None:
    term = objective_of(ColourSettings("l2"), DepthSettings(0.0, "l2", 0.1, opacity_weight=2.0))
    pixels, half = pixel_at(2.0), replace(silhouette(0.9), opacity=torch.full((1,), 0.5, dtype=torch.float64))
    assert term.uses_depth
    assert float(term.loss(half, pixels)) == pytest.approx(2.0 * 0.5 * 0.5**2)
    assert float(term.loss(half, pixel_at(0.0))) == 0
