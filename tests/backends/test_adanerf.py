"""AdaNeRF: bins, the oracle's choice among them, and a training in phases."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Generator, Tensor

from bidnerf.scenes import demo_room, look_around
from bidnerf.scenes import views as seen_from
from bidnerf.testing import SCENE_BOUNDS as BOUNDS
from bidnerf.testing import BackendContract, Recorder, awkward_rays, colour_error, rgbd_views
from bidnerf_adanerf import AdaNerfConfig, AdaNerfField, backend
from bidnerf_adanerf.bins import Bins, choose_samples
from bidnerf_adanerf.dense import dense_samples, render_softly, soft_weights
from bidnerf_adanerf.oracle_loss import ENOUGH, by_depth, by_weight, oracle_loss
from bidnerf_adanerf.recipe import Phase, phase_at, room_for_matter, sparsity
from bidnerf_core.camera import Intrinsics
from bidnerf_core.errors import InputError
from bidnerf_core.fields import FieldValues, Rays, RaySamples, query_samples, render, rendering_weights
from bidnerf_core.frames import View
from bidnerf_core.training import RayBank, TrainingBatch
from optional import require
from simulated_device import StaysOnDevice
from small_backends import ADANERF
from tiny import black_batch
from trainings import assert_same_tensors

SMALL = replace(ADANERF, steps=60)


class TestAdaNerf(StaysOnDevice, BackendContract):
    backend = backend
    config = replace(SMALL, samples_per_step=2048)


@pytest.fixture
def field() -> AdaNerfField:
    """Untrained, with an oracle whose scores differ from bin to bin."""
    made = backend.build(SMALL, BOUNDS)
    with torch.no_grad():
        made.oracle.scores.weight.mul_(20)
        made.oracle.scores.bias.zero_()
    return made.requires_grad_(False)


@pytest.fixture
def rays() -> Rays:
    return awkward_rays()["rays from outside"]


def hit(rays: Rays) -> Tensor:
    return rays.far > rays.near


# Bins.


def test_bins_do_not_move_with_the_limits_of_a_ray(rays: Rays) -> None:
    whole = Bins(BOUNDS, 16)(rays)
    wide = Bins(BOUNDS, 16)(replace(rays, near=0 * rays.near, far=2 * rays.far))
    torch.testing.assert_close(wide.starts[hit(rays)], whole.starts[hit(rays)])
    half = replace(rays, near=(rays.near + rays.far) / 2)
    narrow = Bins(BOUNDS, 16)(half)
    kept = narrow.valid & hit(rays)[:, None]
    assert int(kept.sum(-1).max()) in (8, 9)  # rounding may cut a sliver off the bin before
    assert bool((narrow.starts >= half.near[:, None] - 1e-5)[kept].all())


# The choice.


def test_at_least_one_and_at_most_n_bins_are_chosen(field: AdaNerfField, rays: Rays) -> None:
    for threshold, most in ((0.0, 3), (0.5, 5), (0.999, 2), (1.0, 16), (0.5, 100)):
        sampler = replace(field.sampler, threshold=threshold, most=most)
        count = sampler(rays).valid.sum(-1)
        assert int(count[hit(rays)].min()) >= 1
        assert int(count.max()) <= most
        assert int(count[~hit(rays)].max()) == 0


def test_the_best_bins_are_chosen_nearest_first() -> None:
    edges = torch.linspace(0, 6, 7)
    samples = RaySamples(edges[None, :-1], edges[None, 1:], torch.ones(1, 6, dtype=torch.bool))
    scores = torch.tensor([[0.1, 0.9, 0.2, 0.05, 0.8, 0.3]])
    found = choose_samples(samples, scores, threshold=0.15, most=3)
    assert found.starts[found.valid].tolist() == [1.0, 4.0, 5.0]
    assert choose_samples(samples, scores, threshold=0.85, most=3).valid.sum() == 1
    few = choose_samples(samples, scores, threshold=0.95, most=3)
    assert few.starts[few.valid].tolist() == [1.0]


def test_the_pose_is_felt_through_positions_and_not_through_the_choice(field: AdaNerfField, rays: Rays) -> None:
    """Gradients are the same when the choice is made beforehand and put on the moving ray."""
    origins = rays.origins.clone().requires_grad_()
    samples = field.sampler(rays)
    assert not field.sampler(replace(rays, origins=origins)).starts.requires_grad
    (found,) = torch.autograd.grad(render(field, replace(rays, origins=origins)).rgb.sum(), origins)
    moved = replace(rays, origins=origins)
    values = query_samples(field, moved, samples)
    weights = rendering_weights(values.density, samples)
    (expected,) = torch.autograd.grad((weights[..., None] * values.rgb).sum(), origins)
    torch.testing.assert_close(found, expected)
    assert float(found.abs().max()) > 0


# Dense training.


def made_values(count: int, seed: int = 0) -> FieldValues:
    generator = torch.Generator().manual_seed(seed)
    return FieldValues(
        20 * torch.rand((count, 16), generator=generator), torch.rand((count, 16, 3), generator=generator)
    )


def test_scores_of_one_are_volume_rendering_and_of_zero_are_nothing(rays: Rays) -> None:
    samples, values = Bins(BOUNDS, 16)(rays), made_values(len(rays.near))
    background = torch.full((len(rays.near), 3), 0.3)
    full = render_softly(values, samples, torch.ones_like(samples.starts), background)
    torch.testing.assert_close(full.weights, rendering_weights(values.density, samples), atol=2e-5, rtol=0)
    none = render_softly(values, samples, torch.zeros_like(samples.starts), background)
    torch.testing.assert_close(none.rgb, background)
    assert float(none.opacity.abs().max()) == 0


def test_a_score_weighs_the_opacity_of_its_bin(rays: Rays) -> None:
    samples, values = Bins(BOUNDS, 16)(rays), made_values(len(rays.near))
    scores = torch.rand(samples.starts.shape, generator=torch.Generator().manual_seed(1))
    width = samples.ends - samples.starts
    thinner = -torch.log1p(scores * torch.expm1(-values.density * width)) / width.clamp(min=1e-9)
    expected = rendering_weights(torch.where(samples.valid, thinner, 0.0), samples)
    found = render_softly(values, samples, scores, torch.zeros(len(width), 3)).weights
    torch.testing.assert_close(found, expected, atol=2e-5, rtol=0)


def test_bins_that_will_be_shaded_count_fully_in_the_soft_phase() -> None:
    scores = torch.tensor([[0.0, 0.05, 0.1, 0.2, 0.7, 1.0]], requires_grad=True)
    counted = soft_weights(scores, 0.2)
    torch.testing.assert_close(counted.detach(), torch.tensor([[0.0, 0.25, 0.5, 1.0, 1.0, 1.0]]))
    counted.sum().backward()
    assert bool((require(scores.grad)[0, :3] > 0).all())  # what a picture lacks, the oracle can call back
    assert torch.equal(soft_weights(scores.detach(), 0.0)[0, 1:], torch.ones(5))


def test_gradients_of_soft_rendering_are_finite_where_all_is_opaque(rays: Rays) -> None:
    samples = Bins(BOUNDS, 16)(rays)
    density = torch.full_like(samples.starts, 1e6).requires_grad_()
    scores = torch.ones_like(density).requires_grad_()
    values = FieldValues(density, torch.rand((*density.shape, 3)))
    render_softly(values, samples, scores, torch.zeros(len(density), 3)).rgb.sum().backward()
    assert bool(require(density.grad).isfinite().all() and require(scores.grad).isfinite().all())


def test_bins_without_room_for_matter_are_shaded_now_and_then(field: AdaNerfField, generator: Generator) -> None:
    views = list(rgbd_views())
    room = room_for_matter(views, BOUNDS, 16)
    rays = RayBank(views, BOUNDS).draw(512, generator).rays
    samples, empty = dense_samples(field, rays, room, generator)
    every = field.bins(rays)
    assert 0 < int(empty.sum()) < 0.2 * int(every.valid.sum())
    assert int(samples.valid.sum()) < 0.8 * int(every.valid.sum())
    assert not bool((empty & ~samples.valid).any())
    assert not bool(room.holds(rays.at(samples.middles))[empty].any())
    assert int(dense_samples(field, rays, None, generator)[0].valid.sum()) == int(every.valid.sum())


# What the oracle is taught.


@pytest.fixture
def lessons(rays: Rays) -> tuple[RaySamples, TrainingBatch]:
    """All bins of rays that meet the scene in the middle of their sixth bin."""
    rays = Rays(*(x[hit(rays)] for x in (rays.origins, rays.directions, rays.near, rays.far)))
    samples = Bins(BOUNDS, 16)(rays)
    return samples, black_batch(rays, samples.middles[:, 5])


def slopes(samples: RaySamples, weights: Tensor, batch: TrainingBatch) -> Tensor:
    """Return the gradient of the oracle's loss by its logits, where all are zero."""
    logits = torch.zeros_like(samples.starts, requires_grad=True)
    oracle_loss(logits, samples, weights, batch).backward()
    return require(logits.grad)


def test_measured_depth_teaches_the_oracle(lessons: tuple[RaySamples, TrainingBatch]) -> None:
    samples, batch = lessons
    slope = slopes(samples, torch.zeros_like(samples.starts), batch)
    assert bool((slope[:, 5] < 0).all())  # the score is to rise at the surface
    assert bool((slope[:, [0, 1, 2, 8, 9, 15]] > 0).all())  # and to fall elsewhere
    unmeasured = black_batch(batch.rays, torch.zeros(len(batch)))
    assert float(by_depth(samples, unmeasured).max()) == 0
    torch.testing.assert_close(by_depth(samples, batch)[:, 5], torch.ones(len(samples.starts)))


def test_shaded_bins_teach_the_oracle_without_depth(lessons: tuple[RaySamples, TrainingBatch]) -> None:
    samples, batch = lessons
    unmeasured = black_batch(batch.rays, torch.zeros(len(batch)))
    weights = torch.zeros_like(samples.starts)
    weights[:, 9] = 0.9
    slope = slopes(samples, weights.requires_grad_(), unmeasured)
    assert weights.grad is None  # the shading network is the teacher
    assert bool((slope[:, 9] < 0).all())
    assert bool((slope[:, :8] > 0).all() and (slope[:, 11:] > 0).all())


def test_a_bin_matters_more_the_more_weight_it_has() -> None:
    weights = torch.zeros(5, 16)
    weights[:, 7] = torch.tensor([0.0, 0.1, 0.4, 1.0, 3.0]) * ENOUGH
    target = by_weight(weights)
    torch.testing.assert_close(target[:, 7], torch.tensor([0.0, 0.1, 0.4, 1.0, 1.0]))
    assert bool((target[1:4, 6] < target[1:4, 7]).all())
    assert torch.equal(target[:, 6], target[:, 8])
    assert float(target[:, [5, 9]].max()) == 0


def test_rays_that_miss_the_scene_teach_nothing(rays: Rays) -> None:
    samples, batch = Bins(BOUNDS, 16)(rays), black_batch(rays, torch.zeros_like(rays.near))
    slope = slopes(samples, torch.zeros_like(samples.starts), batch)
    assert float(slope[~hit(rays)].abs().max()) == 0
    assert float(slope[hit(rays)].abs().min()) > 0


# Phases.


def test_sparsity_comes_by_schedule() -> None:
    config = replace(SMALL, steps=100, dense_part=0.4, soft_part=0.2)
    weights = [sparsity(step, config) for step in range(60)]
    assert set(weights[:41]) == {0.0}
    assert weights[40:51] == sorted(weights[40:51])
    assert len(set(weights[40:51])) == 11
    assert set(weights[50:]) == {config.sparsity_weight}


@pytest.mark.parametrize("parts", [(0.4, 0.2), (0.0, 0.5), (1.0, 0.0), (0.0, 0.0), (0.5, 0.5)])
def test_phases_follow_each_other(parts: tuple[float, float]) -> None:
    config = replace(SMALL, steps=100, dense_part=parts[0], soft_part=parts[1])
    found = [phase_at(step, config) for step in range(100)]
    counts = [found.count(phase) for phase in (Phase.DENSE, Phase.SOFT, Phase.SPARSE)]
    assert found == sorted(found, key=list(Phase).index)
    assert counts == [round(100 * part) for part in (*parts, 1 - sum(parts))]


def test_phases_advance_by_schedule_and_the_oracle_is_frozen_in_the_last() -> None:
    config = replace(SMALL, steps=20, dense_part=0.3, soft_part=0.3)
    field, report = backend.build(config, BOUNDS), Recorder()
    learned, last = list[bool](), [p.clone() for p in field.oracle.parameters()]

    def watch(progress: Any) -> None:
        now = [p.detach().clone() for p in field.oracle.parameters()]
        learned.append(not all(torch.equal(a, b) for a, b in zip(last, now, strict=True)))
        last[:] = now

    report.step = watch  # type: ignore[method-assign]
    backend.train(field, rgbd_views(), config, report)
    assert learned == [True] * 12 + [False] * 8


@pytest.mark.parametrize("at", [3, 9, 16])
def test_training_resumes_in_any_phase(at: int) -> None:
    config = replace(SMALL, steps=20, dense_part=0.3, soft_part=0.3)
    whole, report = backend.build(config, BOUNDS), Recorder(due=[at])
    backend.train(whole, rgbd_views(), config, report)
    rest, resumed = backend.build(config, BOUNDS), Recorder(state=report.saved[0])
    backend.train(rest, rgbd_views(), config, resumed)
    assert [p.step for p in resumed.steps] == list(range(at + 1, 21))
    assert [p.loss for p in resumed.steps] == [p.loss for p in report.steps[at:]]
    assert_same_tensors(rest.state_dict(), whole.state_dict())


@pytest.mark.parametrize("depth", [True, False])
def test_samples_become_fewer_and_the_picture_stays(depth: bool) -> None:
    views = [v if depth else replace(v, frame=replace(v.frame, depth=None)) for v in rgbd_views()]
    config = replace(SMALL, steps=150, sparsity_weight=0.2)
    field, report = backend.build(config, BOUNDS), Recorder()
    before = colour_error(field)
    backend.train(field, views, config, report)
    taken = torch.tensor([p.samples_per_ray for p in report.steps])
    first, last = taken[:20].mean(), taken[-20:].mean()
    assert float(last) < 0.5 * float(first)
    assert float(last) <= config.max_samples
    assert colour_error(field) < 0.5 * before


def test_rooms_are_learnt_from_within() -> None:
    """Seen from its middle."""
    room, config = demo_room(), replace(SMALL, steps=100)
    camera = Intrinsics(16.0, 16.0, 12.0, 12.0, 24, 24)
    views: list[View] = seen_from(room, camera, look_around(room.bounds, 8))
    field, report = backend.build(config, room.bounds), Recorder()
    backend.train(field, views, config, report)
    losses = [p.psnr for p in report.steps]
    assert sum(losses[-20:]) / 20 > sum(losses[:20]) / 20 + 2
    batch = RayBank(views, room.bounds).draw(256, torch.Generator().manual_seed(1))
    rendering = render(field, batch.rays, batch.background)
    away = (rendering.distance - batch.observed.distance).abs()
    assert float(away.detach().median()) < 0.15 * max(room.bounds.size)


# Settings.


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"bins": 0}, "bins is 0, expected 1 to"),
        ({"dense_part": 0.7, "soft_part": 0.5}, r"sum to 1\.2, expected at most 1"),
        ({"learning_rate": 0}, "learning_rate is 0, expected more than 0"),
    ],
)
def test_settings_out_of_range_are_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        AdaNerfConfig(**settings)
