"""Fields in closed form: they keep the contract, and volume rendering finds what is known of them."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from bidnerf.scenes import GaussianBlobs, HomogeneousBall, Sphere, orbit
from bidnerf.testing import (
    check_background,
    check_intervals,
    check_levels,
    check_precision,
    check_ranges,
    check_rays_alone,
    check_repeatable,
    check_shapes,
)
from bidnerf_core.fields import RadianceField, Rays, SceneBounds, render

BOUNDS = SceneBounds((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0), 0.1, 8.0)


def rays_towards_the_middle(count: int, generator: torch.Generator) -> Rays:
    """Float64; most of them meet a ball of radius 0.7."""
    origins = torch.stack([T.translation for T in orbit(3.0, count, elevation=(-90, 90))])
    aims = torch.rand((count, 3), generator=generator, dtype=torch.float64) * 1.6 - 0.8
    return BOUNDS.rays(origins, torch.nn.functional.normalize(aims - origins, dim=-1))


@pytest.mark.parametrize(
    "check",
    [
        check_shapes,
        check_ranges,
        check_intervals,
        check_repeatable,
        check_rays_alone,
        check_background,
        check_levels,
        lambda field: check_precision(field, field),
    ],
)
@pytest.mark.parametrize("field", [GaussianBlobs.random(), HomogeneousBall(0.7, 2.0)], ids=lambda f: type(f).__name__)
def test_closed_fields_keep_the_contract(field: RadianceField, check: Callable[[RadianceField], None]) -> None:
    check(field)


def chord(ball: HomogeneousBall, rays: Rays) -> tuple[Tensor, Tensor]:
    """The distances at which each ray enters and leaves the ball in [near, far]; equal if it misses."""
    origins, directions = torch.broadcast_tensors(rays.origins, rays.directions)
    starts = (origins - origins.new_tensor(ball.centre)).reshape(-1, 3).T
    enter, leave = Sphere(ball.radius).interval(starts, directions.reshape(-1, 3).T)
    enter = torch.maximum(enter.reshape(rays.near.shape), rays.near)
    enter = torch.where(enter.isfinite(), enter, rays.near)
    leave = torch.minimum(leave.reshape(rays.near.shape), rays.far)
    return enter, torch.maximum(enter, leave)


def opacity(ball: HomogeneousBall, rays: Rays) -> Tensor:
    """The opacity of each ray by Beer and Lambert."""
    enter, leave = chord(ball, rays)
    return -torch.expm1(-ball.density * (leave - enter))


@pytest.mark.parametrize("density", [0.0, 0.3, 2.0, 40.0])
def test_rendered_opacity_is_beer_lambert(density: float, generator: torch.Generator) -> None:
    ball = HomogeneousBall(0.7, density, rgb=(0.2, 0.5, 0.9), centre=(0.1, -0.05, 0.2))
    rays = rays_towards_the_middle(200, generator)
    enter, leave = chord(ball, rays)
    assert (leave - enter).max() > 1.2
    assert (leave == enter).any()
    # Limited to the chord the samples tile it exactly; limited to the box, borders are missed by an interval or less.
    exact = render(ball, Rays(rays.origins, rays.directions, enter, leave), background=(1.0, 1.0, 1.0))
    torch.testing.assert_close(exact.opacity, opacity(ball, rays), atol=1e-9, rtol=0)
    expected = 1 + opacity(ball, rays)[:, None] * (exact.rgb.new_tensor(ball.rgb) - 1)
    torch.testing.assert_close(exact.rgb, expected, atol=1e-9, rtol=0)
    step = (rays.far - rays.near).max() / 256
    rough = render(ball, rays)
    torch.testing.assert_close(rough.opacity, opacity(ball, rays), atol=float(density * step) + 1e-9, rtol=0)


def test_chord_of_rays_that_start_within_or_point_away() -> None:
    ball = HomogeneousBall(0.5, 1.0)
    origins = torch.tensor([[0.0, 0, 0], [2.0, 0, 0], [2.0, 0, 0], [0.0, 0.6, 0]], dtype=torch.float64)
    directions = torch.tensor([[1.0, 0, 0], [-1.0, 0, 0], [1.0, 0, 0], [1.0, 0, 0]], dtype=torch.float64)
    enter, leave = chord(ball, Rays(origins, directions, torch.zeros(4).double(), torch.full((4,), 5.0).double()))
    assert (leave - enter).tolist() == pytest.approx([0.5, 1.0, 0.0, 0.0])


def test_blobs_are_differentiable_in_position(generator: torch.Generator) -> None:
    field = GaussianBlobs.random(3, seed=1)
    positions = (torch.rand((6, 3), generator=generator, dtype=torch.float64) - 0.5).requires_grad_()

    def answer(x: Tensor) -> tuple[Tensor, Tensor]:
        found = field.query(x, x)
        return found.density, found.rgb

    assert torch.autograd.gradcheck(answer, (positions,))
    assert torch.autograd.gradgradcheck(answer, (positions,))
