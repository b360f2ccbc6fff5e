"""Volume rendering against a slow loop and against closed-form absorption."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch

from balls import HomogeneousBall
from bidnerf.scenes import closed_form_data, closed_form_map
from bidnerf_core.camera import Intrinsics
from bidnerf_core.fields import (
    FieldValues,
    RadianceField,
    Rays,
    RaySamples,
    SceneBounds,
    Stratified,
    inverse_transform,
    query_samples,
    render,
    render_image,
    render_picture,
    render_samples,
    rendering_weights,
    widen,
)
from bidnerf_core.geometry import SE3

BLUE = (0.1, 0.2, 0.9)


def some_rays(count: int, dtype: torch.dtype = torch.float64) -> Rays:
    g = torch.Generator().manual_seed(3)
    origins = torch.nn.functional.normalize(torch.randn(count, 3, generator=g, dtype=dtype), dim=-1) * 4
    targets = 0.5 * torch.randn(count, 3, generator=g, dtype=dtype)
    directions = torch.nn.functional.normalize(targets - origins, dim=-1)
    return SceneBounds((-2, -2, -2), (2, 2, 2), 0.5, 9.0).rays(origins, directions)


@dataclass(frozen=True)
class Gaps:
    """Uneven intervals, some of them not valid."""

    def __call__(self, rays: Rays, jitter: torch.Generator | None = None) -> RaySamples:
        g = torch.Generator().manual_seed(4)
        borders = torch.rand(*rays.near.shape, 13, generator=g, dtype=rays.near.dtype).sort(-1).values
        distance = rays.near[..., None] + (rays.far - rays.near)[..., None] * borders
        valid = torch.rand(*rays.near.shape, 12, generator=g) > 0.3
        return RaySamples(distance[..., :-1], distance[..., 1:], valid)


@dataclass(frozen=True)
class Fog:
    """Density and colour that vary from place to place; counts the points it is asked."""

    sampler: Gaps
    asked: list[int]

    def query(self, positions: torch.Tensor, directions: torch.Tensor) -> FieldValues:
        self.asked.append(math.prod(positions.shape[:-1]))
        density = 1 + torch.sin(3 * positions[..., 0]) + positions[..., 1] ** 2
        return FieldValues(density.abs(), torch.sigmoid(positions * directions))


def render_slowly(field: RadianceField, rays: Rays, samples: RaySamples, background: tuple[float, float, float]):
    """Equation 3, one ray and one sample at a time, in numpy."""
    results = []
    for r in range(len(rays.near)):
        transmittance, colour, distance = 1.0, np.zeros(3), 0.0
        for s in range(samples.starts.shape[-1]):
            if not samples.valid[r, s]:
                continue
            start, end = float(samples.starts[r, s]), float(samples.ends[r, s])
            t = (start + end) / 2
            point = rays.origins[r] + t * rays.directions[r]
            values = field.query(point[None], rays.directions[r][None])
            alpha = 1 - math.exp(-float(values.density[0]) * (end - start))
            colour += transmittance * alpha * values.rgb[0].numpy()
            distance += transmittance * alpha * t
            transmittance *= 1 - alpha
        results.append((colour + transmittance * np.array(background), distance, 1 - transmittance))
    return [np.array(part) for part in zip(*results, strict=True)]


def test_rendering_is_the_slow_loop() -> None:
    rays, field = some_rays(20), Fog(Gaps(), [])
    rendering = render(field, rays, BLUE)
    expected = render_slowly(Fog(Gaps(), []), rays, Gaps()(rays), BLUE)
    for found, part in zip((rendering.rgb, rendering.distance, rendering.opacity), expected, strict=True):
        np.testing.assert_allclose(found.numpy(), part, atol=1e-12)


def test_only_valid_samples_are_queried() -> None:
    rays, field = some_rays(20), Fog(Gaps(), [])
    samples = Gaps()(rays)
    query_samples(field, rays, samples)
    assert field.asked == [int(samples.valid.sum())]
    nothing = RaySamples(samples.starts, samples.ends, torch.zeros_like(samples.valid))
    assert float(query_samples(field, rays, nothing).density.abs().max()) == 0
    assert field.asked[-1] == 0


def test_derivatives_of_a_rendering_with_gaps_are_the_numerical_ones() -> None:
    rays, field = some_rays(6), Fog(Gaps(), [])
    samples = field.sampler(rays)
    assert 0 < int(samples.valid.sum()) < samples.valid.numel()

    def function(origins: torch.Tensor, directions: torch.Tensor) -> tuple[torch.Tensor, ...]:
        rendering = render_samples(field, Rays(origins, directions, rays.near, rays.far), samples, BLUE)
        return rendering.rgb, rendering.distance, rendering.opacity, rendering.weights

    of = (rays.origins.clone().requires_grad_(), rays.directions.clone().requires_grad_())
    assert torch.autograd.gradcheck(function, of)


@pytest.mark.parametrize("leading", [(12,), (3, 4), (1, 12)])
def test_what_is_not_valid_changes_nothing(leading: tuple[int, ...]) -> None:
    """Rendering with gaps equals rendering the whole rays with a field that has no density in the gaps."""
    flat, field = some_rays(12), Fog(Gaps(), [])
    parts = (flat.origins, flat.directions, flat.near, flat.far)
    rays = Rays(
        *(part.reshape(*leading, *part.shape[1:]).requires_grad_() for part in parts[:2]),
        *(part.reshape(leading) for part in parts[2:]),
    )
    samples = field.sampler(rays)
    values = field.query(rays.at(samples.middles), rays.directions[..., None, :].expand(*leading, 12, 3))
    everywhere = replace(samples, valid=torch.ones_like(samples.valid))
    weights = rendering_weights(values.density * samples.valid, everywhere)
    rgb = (weights[..., None] * values.rgb).sum(-2) + (1 - weights.sum(-1))[..., None] * torch.tensor(BLUE)
    found = render_samples(field, rays, samples, BLUE)
    torch.testing.assert_close(found.rgb, rgb)
    torch.testing.assert_close(found.weights, weights)
    of = [rays.origins, rays.directions]
    gradients = [torch.autograd.grad(colour.sin().sum(), of) for colour in (found.rgb, rgb)]
    torch.testing.assert_close(*gradients)


@pytest.mark.parametrize("density", [0.0, 1e-6, 0.3, 20.0])
def test_absorption_in_a_homogeneous_ball(density: float) -> None:
    """Opacity is 1 - exp(-sigma chord), and the mean distance that of an exponential law cut off at the chord's end."""
    radius, axis_distance = 1.0, 0.4
    ball = HomogeneousBall(radius=radius, density=density)
    origin = torch.tensor([[0.0, axis_distance, -3.0]], dtype=torch.float64)
    half = math.sqrt(radius**2 - axis_distance**2)
    near, far = torch.tensor([3 - half]).double(), torch.tensor([3 + half]).double()
    rays = Rays(origin, torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64), near, far)
    rendering = render(replace(ball, sampler=Stratified(4000)), rays, BLUE)
    chord = 2 * half
    assert float(rendering.opacity) == pytest.approx(1 - math.exp(-density * chord), abs=1e-7)
    if density == 0:
        torch.testing.assert_close(rendering.rgb, torch.tensor([BLUE], dtype=torch.float64))
    if density > 0.1:
        gone = math.exp(-density * chord)
        mean = float(near) * (1 - gone) + (1 - gone * (1 + density * chord)) / density
        assert float(rendering.distance) == pytest.approx(mean, abs=1e-4)


def test_weights_sum_to_opacity_whatever_the_subdivision() -> None:
    """Cutting every interval of a piecewise constant density in two changes nothing."""
    g = torch.Generator().manual_seed(0)
    borders = torch.rand(5, 9, generator=g, dtype=torch.float64).sort(-1).values
    density = 10 * torch.rand(5, 8, generator=g, dtype=torch.float64)
    whole = RaySamples(borders[:, :-1], borders[:, 1:], torch.ones(5, 8, dtype=torch.bool))
    middles = whole.middles
    starts = torch.stack([whole.starts, middles], -1).flatten(1)
    ends = torch.stack([middles, whole.ends], -1).flatten(1)
    halves = RaySamples(starts, ends, torch.ones(5, 16, dtype=torch.bool))
    coarse = rendering_weights(density, whole)
    fine = rendering_weights(density.repeat_interleave(2, -1), halves)
    torch.testing.assert_close(fine.unflatten(1, (8, 2)).sum(-1), coarse)
    assert float(coarse.sum(-1).max()) <= 1


def test_importance_sampling_gathers_where_the_weight_is() -> None:
    borders = torch.linspace(0, 8, 9)[None]
    rough = RaySamples(borders[:, :-1], borders[:, 1:], torch.ones(1, 8, dtype=torch.bool))
    weights = torch.tensor([[0, 0, 3.0, 0, 0, 1.0, 0, 0]])
    found, owner = inverse_transform(rough, weights, 400, None)
    assert set(owner.unique().tolist()) == {2, 5}
    assert float(((found >= 2) & (found <= 3)).float().mean()) == pytest.approx(0.75, abs=0.01)
    assert float(((found >= 5) & (found <= 6)).float().mean()) == pytest.approx(0.25, abs=0.01)
    # uniform within an interval
    inside = found[(found > 2) & (found < 3)]
    assert float(inside.mean()) == pytest.approx(2.5, abs=0.01)
    assert float(inside.std()) == pytest.approx(1 / math.sqrt(12), abs=0.01)


def test_wide_rays_are_twice_as_long_about_the_same_middle() -> None:
    rays = some_rays(30)
    wide = widen(rays, 2.0)
    inside = (wide.near > 0) & (rays.far > rays.near)
    length = (wide.far - wide.near)[inside] / (rays.far - rays.near)[inside]
    torch.testing.assert_close(length, torch.full_like(length, 2.0))
    assert float(wide.near.min()) >= 0


def test_box_clips_rays_as_a_slow_march_does() -> None:
    bounds = SceneBounds((-1.0, -0.5, -2.0), (0.5, 1.5, 1.0), 0.1, 6.0)
    rays = bounds.rays(some_rays(40).origins, some_rays(40).directions)
    march = torch.linspace(0.1, 6.0, 20001, dtype=torch.float64)
    points = rays.at(march.expand(40, -1))
    inside = ((points > torch.tensor(bounds.lower).double()) & (points < torch.tensor(bounds.upper).double())).all(-1)
    step = float(march[1] - march[0])
    for r in range(40):
        hit = march[inside[r]]
        if len(hit) == 0:
            assert float(rays.far[r] - rays.near[r]) <= 2 * step
        else:
            assert float(hit[0]) == pytest.approx(float(rays.near[r]), abs=2 * step)
            assert float(hit[-1]) == pytest.approx(float(rays.far[r]), abs=2 * step)


def test_a_rendered_image_has_planar_depth() -> None:
    """A camera before a dense slab sees one depth everywhere, though distances along the rays differ."""

    @dataclass(frozen=True)
    class Slab:
        sampler: Stratified

        def query(self, positions: torch.Tensor, directions: torch.Tensor) -> FieldValues:
            inside = positions[..., 2] > 2.0
            return FieldValues(1e4 * inside.to(positions.dtype), torch.ones_like(positions))

    bounds = SceneBounds((-9, -9, 0), (9, 9, 3), 0.0, 20.0)
    camera = Intrinsics(20.0, 24.0, 9.5, 8.0, 20, 16)
    image = render_image(Slab(Stratified(3000)), camera, SE3.identity(), bounds)
    torch.testing.assert_close(image.depth, torch.full((16, 20), 2.0), atol=5e-3, rtol=0)
    assert image.rgb.shape == (16, 20, 3)
    assert float(image.opacity.min()) > 0.999


@pytest.mark.parametrize("size", [(64, 48), (63, 49), (1, 1), (2, 3)])
def test_a_picture_is_nearly_the_image_and_renders_fewer_pixels(size: tuple[int, int]) -> None:
    scene = closed_form_map("demo:blobs")
    camera = Intrinsics.from_hfov(50, *size)
    data = closed_form_data("demo:blobs")
    pose = data.views("test", data.frame_names("test")[:1])[0].T_ref_camera
    counted = 0

    class Counting:
        def __init__(self, field: RadianceField) -> None:
            self.field, self.sampler = field, self.sample

        def sample(self, rays: Rays, jitter: torch.Generator | None = None) -> RaySamples:
            nonlocal counted
            counted += rays.near.numel()
            return self.field.sampler(rays, jitter)

        def query(self, positions: torch.Tensor, directions: torch.Tensor) -> FieldValues:
            return self.field.query(positions, directions)

    whole = render_image(scene.field, camera, pose, scene.bounds)
    picture = render_picture(Counting(scene.field), camera, pose, scene.bounds)
    assert torch.equal(picture.rgb[::2, ::2], whole.rgb[::2, ::2])
    pixels = camera.width * camera.height
    if pixels < 10:  # what is smaller than two pixels may be missed
        assert counted <= pixels
        return
    assert counted < 0.8 * pixels
    assert float((picture.rgb - whole.rgb).square().mean()) < 1e-4  # 40 dB
    both = (picture.depth > 0) & (whole.depth > 0)
    assert torch.equal(both, (picture.depth > 0) | (whole.depth > 0))
    assert float(((picture.depth - whole.depth)[both] / whole.depth[both]).abs().max()) < 0.12
