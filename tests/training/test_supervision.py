"""Depth supervision: what the term asks for, and that every backend's recipe heeds it, however few pixels were measured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import pytest
import torch

import tiny
from bidnerf_core.fields import RadianceField, Rays, RaySamples, Rendering, render, rendering_weights
from bidnerf_core.frames import SeenLandmarks, View
from bidnerf_core.training import RayBank, TrainingBatch, ray_termination, supervised_loss

# Inside: single terms of the loss are compared with their definitions, integrals and differences
from bidnerf_core.training.loss import distortion, expected_distance
from bidnerf_core.training.ray_bank import LANDMARK_SHARE
from optional import require
from small_backends import BACKENDS, BOUNDS, train_field


def ray(density: torch.Tensor, measured: float) -> tuple[Rendering, TrainingBatch]:
    """One ray through ten cells of half a metre, and what was measured along it."""
    borders = torch.linspace(0, 5, 11, dtype=density.dtype)[None]
    samples = RaySamples(borders[:, :-1], borders[:, 1:], torch.ones(1, 10, dtype=torch.bool))
    weights = rendering_weights(density[None], samples)
    distance = (weights * samples.middles).sum(-1)
    rgb = torch.zeros(1, 3, dtype=density.dtype)
    zero = density.new_zeros(1, 3)
    batch = tiny.black_batch(Rays(zero, zero, zero[:, 0], zero[:, 0] + 5), density.new_tensor([measured]))
    return Rendering(rgb, distance, weights.sum(-1), weights, samples), batch


def test_the_derivative_is_the_numerical_one() -> None:
    density = torch.rand(10, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    assert torch.autograd.gradcheck(
        lambda d: ray_termination(*ray(d, 3.25)), density.requires_grad_(), eps=1e-6, atol=1e-8
    )


def thinned(view: View, every: int) -> View:
    """The view with every so many of the pixels of its depth image alone."""
    depth = require(view.frame.depth)
    kept = torch.zeros_like(depth)
    index = depth.nonzero()[::every].unbind(-1)
    kept[index] = depth[index]
    return replace(view, frame=replace(view.frame, depth=kept))


def misplaced(field: RadianceField, views: Sequence[View]) -> float:
    """The depth term where depth was measured: mean distance of the weight from there, metres."""
    batch = RayBank(views, BOUNDS).draw(3000, torch.Generator().manual_seed(1))
    with torch.no_grad():
        return float(ray_termination(render(field, batch.rays, batch.background), batch))


@pytest.mark.parametrize("name", BACKENDS)
def test_a_single_measured_pixel_and_none_are_fine(name: str) -> None:
    one = [thinned(view, 10**6) for view in tiny.views()]
    none = [replace(v, frame=replace(v.frame, depth=None)) for v in one]
    for views, carve in ((one, True), (one, False), (none, True), ([one[0], *none[1:]], True)):
        field = train_field(name, views, steps=4, depth_weight=1.0, carve=carve)
        assert all(bool(p.isfinite().all()) for p in field.parameters())


# Landmarks.


@pytest.mark.parametrize("sigma", [0.05, 0.4, 2.0])
def test_the_expected_distance_is_the_mean_of_draws(sigma: float) -> None:
    offset = torch.tensor([-3.0, -0.5, 0.0, 0.2, 1.7], dtype=torch.float64)
    errors = sigma * torch.randn(200_000, 1, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    expected = (offset + errors).abs().mean(0)
    found = expected_distance(offset, torch.tensor(sigma, dtype=torch.float64).expand(5))
    torch.testing.assert_close(found, expected, rtol=0, atol=4 * sigma / 200_000**0.5)


def test_the_expected_distance_has_the_derivative_that_differences_show() -> None:
    offset = torch.tensor([-2.0, -0.3, 0.1, 0.9], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda o: expected_distance(o, torch.full_like(o, 0.5)), offset)


def test_a_landmark_pulls_weight_to_itself_and_less_the_less_certain_it_is() -> None:
    def slope(deviation: float) -> torch.Tensor:
        density = torch.full((10,), 0.01, dtype=torch.float64, requires_grad=True)
        rendering, batch = ray(density, 3.25)
        batch = replace(batch, deviation=torch.full_like(batch.deviation, deviation))
        return torch.autograd.grad(ray_termination(rendering, batch), density)[0]

    sharp, vague = slope(0.1), slope(2.0)
    assert int(sharp.argmin()) == int(vague.argmin()) == 6
    assert float(vague[6] - vague[4]) > float(sharp[6] - sharp[4])  # both negative


def seen(view: View, every: int) -> View:
    """The view with the depth of some pixels as landmarks, and no depth."""
    depth = require(view.frame.depth)
    rows, columns = (depth > 0).nonzero()[::every].unbind(-1)
    pixels = torch.stack([columns, rows], dim=-1) + 0.5
    ray = view.frame.intrinsics.unproject(pixels)
    distance = depth[rows, columns] * torch.linalg.vector_norm(ray, dim=-1)
    landmarks = SeenLandmarks(pixels, distance, torch.full_like(distance, 0.01))
    return replace(view, frame=replace(view.frame, depth=None), landmarks=landmarks)


def test_a_share_of_the_rays_ends_at_landmarks_where_they_are() -> None:
    views = tiny.views()
    batch = RayBank([seen(view, 7) for view in views], BOUNDS).draw(800, torch.Generator().manual_seed(1))
    known = batch.observed.measured
    assert int(known.sum()) == round(LANDMARK_SHARE * 800)
    assert torch.equal(known, batch.deviation > 0)
    exact = RayBank(views, BOUNDS)
    points = batch.observed[known].points
    surface = exact.draw(20_000, torch.Generator().manual_seed(2)).observed
    off = torch.cdist(points, surface[surface.measured].points).amin(1)
    assert float((off < 1e-3).float().mean()) > 0.95  # each is a pixel's point, and nearly all pixels were drawn


@pytest.mark.parametrize("name", BACKENDS)
def test_every_backend_heeds_sparse_depth_and_landmarks(name: str) -> None:
    """One pixel in ten with depth, or with a landmark, brings the matter of all pixels nearer to where it is."""
    dense = tiny.views()
    sparse, landmarks = [thinned(view, 10) for view in dense], [seen(view, 10) for view in dense]
    assert 0 < sum(int((v.frame.depth > 0).sum()) for v in sparse) < 400  # type: ignore[operator]
    without = misplaced(train_field(name, sparse, depth_weight=0.0), dense)
    for views in (sparse, landmarks):
        assert misplaced(train_field(name, views, depth_weight=1.0), dense) < 0.9 * without


# Distortion.


def test_distortion_is_the_double_sum_of_its_definition() -> None:
    rendering, _ = ray(torch.rand(10, generator=torch.Generator().manual_seed(4), dtype=torch.float64), 0.0)
    weights, middles = rendering.weights[0], rendering.samples.middles[0] / 2.5
    width = (rendering.samples.ends - rendering.samples.starts)[0] / 2.5
    pairs = (weights[:, None] * weights * (middles[:, None] - middles).abs()).sum()
    expected = pairs + (weights**2 * width).sum() / 3
    torch.testing.assert_close(distortion(rendering, 2.5), expected)


def test_rays_without_depth_do_not_count() -> None:
    density = torch.full((10,), 0.3, dtype=torch.float64, requires_grad=True)
    loss = ray_termination(*ray(density, 0.0))
    assert float(loss.detach()) == 0
    assert not torch.autograd.grad(loss, density)[0].any()
    rendering, batch = ray(density, 3.25)
    assert supervised_loss(rendering, batch, 2.0, 0.0)[0] == 0
