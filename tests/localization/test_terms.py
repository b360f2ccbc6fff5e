"""Terms without landmarks: derivatives against numerical ones, what exposure and occluders change, and which device they stay on."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from scipy.ndimage import convolve1d
from torch import Tensor

import baked
from bidnerf.scenes import GaussianBlobs, orbit
from bidnerf_core.camera import Intrinsics
from bidnerf_core.fields import (
    FieldValues,
    RadianceField,
    RayHits,
    Rays,
    RaySampler,
    SceneBounds,
    Stratified,
    differentiate,
    render,
    render_image,
)
from bidnerf_core.frames import Frame, Thumbnail, View, averaged, smooth
from bidnerf_core.geometry import SE3
from bidnerf_core.localization import (
    ColourSettings,
    DepthLossSettings,
    Images,
    Problem,
    RenderedRays,
    draw_rays,
    rig,
    states_at,
)

# Inside: exposures and renderers of images, of which a descent sees only sums
from bidnerf_core.localization.terms.exposure import eliminate, fit_exposure
from bidnerf_core.localization.terms.images import (
    field_renderer,
    surface_renderer,
)
from bidnerf_core.localization.terms.surface import draw_numbers
from bidnerf_core.mapping import States, descend
from problems import FieldMap
from tiny import depth_rays_of

BOUNDS = SceneBounds((-2.0, -2.0, -2.0), (2.0, 2.0, 2.0), 0.1, 12.0, (1.0, 0.9, 0.8))
BLOBS = GaussianBlobs.random(samples=128)
CAMERA = Intrinsics(48.0, 48.0, 24.0, 20.0, 48, 40)
T0, T1 = orbit(4.0, 2, seed=1)


@dataclass(frozen=True)
class Sheets:
    """Two coloured half-transparent sheets, z = 0.3 and z = -0.4, that rays hit; it has no density to sample."""

    sampler: RaySampler = Stratified(4)

    def query(self, positions: Tensor, directions: Tensor) -> FieldValues:
        return FieldValues(torch.zeros_like(positions[..., 0]), positions * 0)

    def hits(self, rays: Rays) -> RayHits:
        planes = torch.tensor([0.3, -0.4]).to(rays.origins)
        along = (planes - rays.origins[..., 2:]) / rays.directions[..., 2:]
        order = along.argsort(-1)
        along = along.gather(-1, order)
        points = rays.at(along)
        rgb = torch.sigmoid(torch.stack([points[..., 0], points[..., 1], points.sum(-1)], -1))
        alpha = 0.8 * torch.exp(-points[..., :2].square().sum(-1))
        valid = along > rays.near[..., None]
        return RayHits(along, torch.where(valid, alpha, 0), rgb, valid)


def observed(field: RadianceField, T: SE3 = T0) -> View:
    image = render_image(field, CAMERA, T, BOUNDS)
    return View(Frame("frame", image.rgb, CAMERA, image.depth), SE3.identity())


def problem(field: RadianceField, *views: View) -> Problem:
    return rig(FieldMap(field, BOUNDS), views or [observed(field)], T0)


def near(T: SE3 = T0) -> States:
    off = torch.tensor([0.02, -0.03, 0.05, 0.01, 0.02, -0.02], dtype=torch.float64)
    return states_at(SE3.stack([T.retract(off), T.retract(-0.7 * off)]))


def numerical(cost, states: States, step: float) -> Tensor:  # type: ignore[no-untyped-def]
    found = []
    for axis in range(6):
        d = torch.zeros((len(states), 19), dtype=torch.float64)
        d[:, axis] = step
        found.append((cost(states.retract(d)) - cost(states.retract(-d))) / (2 * step))
    return torch.stack(found, -1)


@pytest.mark.parametrize("field", [BLOBS, Sheets()], ids=["density", "hits"])
@pytest.mark.parametrize("depth", [False, True], ids=["RGB", "RGB-D"])
def test_the_gradient_by_rays_is_the_numerical_one(
    monkeypatch: pytest.MonkeyPatch, field: RadianceField, depth: bool
) -> None:
    """Fields are float32, and the intervals that are sampled, which have no derivative, move with the rays."""
    monkeypatch.setattr("bidnerf_core.fields.differentiation.LEAST_WEIGHT", 0.0)
    of_depth = DepthLossSettings(depth_loss="cauchy") if depth else None
    rays = draw_rays(problem(field), ColourSettings("cauchy"), of_depth, 100, 0)
    normal = rays(near())
    expected = numerical(lambda states: rays(states).cost, near(), 2e-3)
    torch.testing.assert_close(normal.gradient[:, :6], expected, rtol=0.05, atol=0.03 * float(expected.abs().max()))
    assert float(torch.linalg.eigvalsh(normal.hessian).min()) > -1e-6 * float(normal.hessian.abs().max())


@pytest.mark.parametrize("field", [BLOBS, Sheets()], ids=["density", "hits"])
def test_derivatives_of_rays_are_those_of_autograd_ray_by_ray(
    monkeypatch: pytest.MonkeyPatch, field: RadianceField
) -> None:
    monkeypatch.setattr("bidnerf_core.fields.differentiation.LEAST_WEIGHT", 0.0)
    generator = torch.Generator().manual_seed(0)
    directions = T0.to(torch.float32).rotate(CAMERA.rays(CAMERA.pixel_centres().reshape(-1, 2)[::97])[0].float())
    origins = T0.translation.float() + 0.1 * torch.rand(directions.shape, generator=generator)
    rays = BOUNDS.rays(origins, directions)
    value, *gradients = differentiate(field, rays, BOUNDS.background)
    o, d = origins.requires_grad_(), directions.requires_grad_()
    seen = render(field, replace(rays, origins=o, directions=d), BOUNDS.background).rgb
    torch.testing.assert_close(value, seen.detach())
    for channel in range(3):
        for ray in (0, 7, 12):
            exact = torch.autograd.grad(seen[ray, channel], (o, d), retain_graph=True)
            for ours, theirs in zip(gradients, exact, strict=True):
                torch.testing.assert_close(ours[ray, channel], theirs[ray], rtol=1e-3, atol=1e-4)


def test_rays_that_hit_nothing_have_no_derivative() -> None:
    away = states_at(T0.retract(torch.tensor([0, 0, 0, 3.14, 0, 0], dtype=torch.float64))[None])
    rays = replace(draw_rays(problem(BLOBS), ColourSettings(), None, 50, 0), exposure=False)
    normal = rays(away)
    assert not bool(normal.gradient.any())
    assert float(normal.cost) > 0


def test_measured_rays_of_another_sensor_join_pixels(monkeypatch: pytest.MonkeyPatch) -> None:
    """They have no colour, and their distances alone lead back to the pose."""
    monkeypatch.setattr("bidnerf_core.fields.differentiation.LEAST_WEIGHT", 0.0)
    lidar = depth_rays_of([observed(BLOBS)])
    blank = View(Frame("blank", torch.zeros((40, 48, 3)), CAMERA, has_colour=False), SE3.identity())
    given = rig(FieldMap(BLOBS, BOUNDS), [blank], T0, lidar)
    rays = draw_rays(given, ColourSettings(), DepthLossSettings(), 60, 0)
    assert float(rays.coloured.sum()) == 0
    normal = rays(near())
    expected = numerical(lambda states: rays(states).cost, near(), 2e-3)
    torch.testing.assert_close(normal.gradient[:, :6], expected, rtol=0.05, atol=0.05 * float(expected.abs().max()))
    costs = rays(States.cat([near(), states_at(T0[None])])).cost
    assert int(costs.argmin()) == 2


def test_an_image_of_other_exposure_costs_the_same_once_it_is_eliminated() -> None:
    view = observed(BLOBS)
    darker = replace(view, frame=replace(view.frame, rgb=0.7 * view.frame.rgb + 0.1))
    colour = ColourSettings("geman-mcclure")
    plain, other = (draw_rays(problem(BLOBS, v), colour, None, 300, 0) for v in (view, darker))
    truth = states_at(T0[None])
    assert float(other(truth).cost) < 0.02 * float(other(near()).cost.min())
    assert float(plain(truth).cost) < 0.02 * float(plain(near()).cost.min())
    fixed = replace(other, exposure=False)
    assert float(fixed(truth).cost) > 10 * float(other(truth).cost)


def test_steep_rays_are_drawn_where_the_image_changes_and_cost_least_at_the_truth() -> None:
    view = observed(BLOBS)
    given, truth = problem(BLOBS, view), states_at(T0[None])
    even, steep = (RenderedRays.of(given.views, BLOBS, BOUNDS, 60, 0, steep=steep) for steep in (False, True))
    # Fewer of them have the most frequent colour, that of the background.
    background = view.frame.rgb.flatten(0, 1).mode(0).values.double()
    plain = [float((rays.rgb - background).norm(dim=-1).lt(0.02).double().mean()) for rays in (even, steep)]
    assert plain[1] < 0.7 * plain[0]
    assert float(steep.loss_at(truth)) < 0.1 * float(steep.loss_at(near()).min())
    # The first rays are a sample of all.
    assert torch.equal(steep.first(20).rgb, steep.rgb[:20])


def test_as_many_rays_as_wanted_are_drawn_where_most_pixels_are_hidden(generator: torch.Generator) -> None:
    hidden = torch.ones(100_000, dtype=torch.bool)
    hidden[500:600] = False
    drawn = draw_numbers(len(hidden), 50, generator, hidden)
    assert len(drawn.unique()) == 50
    assert not hidden[drawn].any()


def test_the_rays_of_a_mirror_image_agree_if_their_sights_are_mirrored() -> None:
    view = observed(BLOBS)
    flipped = replace(view, frame=replace(view.frame, rgb=view.frame.rgb.flip(1).contiguous()))
    rays = RenderedRays.of(problem(BLOBS, flipped).views, BLOBS, BOUNDS, 200, 0)
    truth = states_at(T0[None])
    assert float(replace(rays, sights=rays.sights.mirrored).loss_at(truth)) < 0.1 * float(rays.loss_at(truth))


def test_gain_and_offset_are_found_beside_outliers_and_have_no_derivative_left(
    generator: torch.Generator,
) -> None:
    seen = torch.rand((2, 400, 3), generator=generator, dtype=torch.float64)
    gain, offset = torch.tensor([0.6, 1.0, 1.3]), torch.tensor([0.1, 0.0, -0.05])
    measured = gain * seen[0] + offset
    measured[:100] = torch.rand((100, 3), generator=generator, dtype=torch.float64)
    known = torch.ones((1, 400, 1), dtype=torch.float64)
    found = fit_exposure(seen, measured, lambda off: 1 / (1 + (off / 0.1) ** 2) ** 2, known, (1e-6, 0.0), 20)
    torch.testing.assert_close(found[0][0, 0], gain.double(), rtol=0.02, atol=0)
    torch.testing.assert_close(found[1][0, 0], offset.double(), rtol=0, atol=0.01)
    rows = torch.rand((2, 400, 3, 6), generator=generator, dtype=torch.float64)
    weight = torch.rand((2, 400, 3), generator=generator, dtype=torch.float64)
    left = weight[..., None] * eliminate(rows, seen, weight)
    assert float(left.sum(1).abs().max()) < 1e-9
    assert float((seen[..., None] * left).sum(1).abs().max()) < 1e-9


def test_points_on_their_surface_cost_least_in_any_world_frame() -> None:
    view = baked.unseen()[0]
    term = replace(baked.points(view), colour_weight=1.0)
    truth = states_at(view.T_ref_camera[None])
    costs = term.costs(States.cat([truth, near(view.T_ref_camera)])).mean(-1)
    assert int(costs.argmin()) == 0
    near_points, alike = term.inliers(truth)
    assert float(near_points.mean()) > 0.9
    assert float(alike.mean()) > 0.7
    darker = replace(term, rgb=0.6 * term.rgb + 0.1)
    restored = darker.match_exposure(truth)
    assert float(restored.inliers(truth)[1].mean()) > float(darker.inliers(truth)[1].mean())
    assert term.match_exposure(truth) is term


def small_image(width: int = 24) -> tuple[Images, SE3]:
    view = baked.unseen()[0]
    renderer = surface_renderer(baked.toy(), baked.BOUNDS.background)
    small = Thumbnail.of(View(view.frame, SE3.identity()), width)
    return Images(renderer, [small]), view.T_ref_camera


def test_small_images_cost_least_at_the_truth_and_a_step_leads_back(generator: torch.Generator) -> None:
    term = Images(field_renderer(BLOBS, BOUNDS), [Thumbnail.of(observed(BLOBS), 24)])
    xi = torch.randn((6, 6), generator=generator, dtype=torch.float64)
    xi = torch.nn.functional.normalize(xi, dim=-1) * torch.tensor([0.1] * 3 + [0.03] * 3)
    xi[0] = 0
    states = states_at(SE3(T0.rotation.expand(6, 3, 3), T0.translation.expand(6, 3)).retract(xi))
    normal = term(states)
    assert int(normal.cost.argmin()) == 0
    moved, after = descend(states, [term], 4)
    assert bool((after.cost <= normal.cost).all())
    off = (moved.T.inverse() @ T0).log().norm(dim=-1)
    assert float(off.median()) < 0.35 * float(xi[1:].norm(dim=-1).median())


def test_a_rig_is_the_mean_of_its_views_and_no_broken_pose_is_best() -> None:
    one, T = small_image(16)
    other = Thumbnail.of(View(baked.unseen()[1].frame, T.inverse() @ baked.unseen()[1].T_ref_camera), 16)
    both = replace(one, thumbnails=[*one.thumbnails, other])
    parts = [one(near(T)), replace(one, thumbnails=[other])(near(T))]
    torch.testing.assert_close(both(near(T)).cost, (parts[0].cost + parts[1].cost) / 2)
    torch.testing.assert_close(both(near(T)).hessian, (parts[0].hessian + parts[1].hessian) / 2)
    broken = SE3(torch.stack([T.rotation, T.rotation * torch.nan]), T.translation.expand(2, 3))
    assert both(states_at(broken)).cost.isinf().tolist() == [False, True]


@pytest.mark.parametrize("factor", [0.5, 1.6])
def test_small_images_find_the_truth_at_another_exposure(factor: float) -> None:
    term, T = small_image()
    frame = baked.unseen()[0].frame
    exposed = replace(frame, rgb=(factor * frame.rgb).clamp(max=1))
    changed = replace(term, thumbnails=[Thumbnail.of(View(exposed, SE3.identity()), 24)], gain=1.0, rounds=5)
    assert int(changed(States.cat([states_at(T[None]), near(T)])).cost.argmin()) == 0


PINHOLE = Intrinsics(100.0, 104.0, 47.0, 33.0, 96, 64)
LENS = Intrinsics(100.0, 104.0, 47.0, 33.0, 96, 64, (-0.2, 0.05, 0.001, -0.002))


@pytest.mark.parametrize("camera", [PINHOLE, LENS], ids=["pinhole", "lens"])
def test_where_the_pixels_of_a_thumbnail_look(camera: Intrinsics) -> None:
    """Colours that change evenly with where a pixel looks."""
    x, y, _ = camera.unproject(camera.pixel_centres()).unbind(-1)
    rgb = torch.stack([0.5 + 0.4 * x, 0.5 + 0.4 * y, 0.5 + 0.2 * x - 0.3 * y], -1)
    small = Thumbnail.of(View(Frame("even", rgb, camera), T1), 24)
    assert (small.camera.width, small.camera.height, small.camera.distortion) == (24, 16, ())
    x, y, _ = small.flat.view(16, 24, 3)[3:-3, 3:-3].reshape(-1, 3).unbind(-1)
    expected = torch.stack([0.5 + 0.4 * x, 0.5 + 0.4 * y, 0.5 + 0.2 * x - 0.3 * y], -1)
    torch.testing.assert_close(small.rgb[:, 3:-3, 3:-3].flatten(1).T, expected, rtol=0, atol=5e-3)
    inner = small.slopes.view(3, 16, 24, 2)[:, 4:-4, 4:-4].flatten(1, 2).mean(1)
    torch.testing.assert_close(inner, torch.tensor([[0.4, 0.0], [0.0, 0.4], [0.2, -0.3]]), rtol=0, atol=0.02)


def test_smooth_is_scipys_convolution(generator: torch.Generator) -> None:
    image = torch.rand((2, 3, 9, 14), generator=generator)
    kernel = np.array([1, 4, 6, 4, 1]) / 16
    expected = image.numpy()
    for axis in (-1, -2):
        expected = convolve1d(expected, kernel, axis=axis, mode="nearest")
    torch.testing.assert_close(smooth(image), torch.from_numpy(expected), rtol=0, atol=1e-6)


@pytest.mark.parametrize("size", [2, 7, 100])
def test_averages_keep_means_and_places(size: int) -> None:
    u, v = CAMERA.pixel_centres().unbind(-1)
    even = Frame("even", torch.stack([u / 48, v / 40, torch.full_like(u, 0.3)], -1), CAMERA)
    found, inside = averaged(even, size), slice(size, -2 * size)
    torch.testing.assert_close(found[..., 2], even.rgb[..., 2])
    off = (found - even.rgb)[inside, inside]
    assert off.numel() == 0 or float(off.abs().max()) < 5e-3
