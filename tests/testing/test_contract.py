"""The contract for backends: good ones keep it, and each way of breaking it is told by its name."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Generator, Tensor, nn

import tiny
from bidnerf_core.fields import (
    FieldValues,
    RayHits,
    Rays,
    RaySamples,
    SceneBounds,
    Stratified,
    device_of,
    render,
)
from bidnerf_core.frames import View
from bidnerf_core.testing import BackendContract
from bidnerf_core.training import (
    RayBank,
    Report,
    StepOutcome,
    Supervision,
    SupervisionConfig,
    TrainingStopped,
    fit,
    supervised_loss,
)
from bidnerf_hashgrid import backend as hashgrid


class TestHashGrid(BackendContract):
    backend = hashgrid
    config = tiny.config(steps=60, learning_rate=0.05)


@dataclass(frozen=True)
class WaveConfig:
    """A few sine waves through a linear layer: the least that learns."""

    steps: int = 60
    waves: int = 32
    samples: int = 16
    seed: int = 0
    layers: tuple[int, ...] = (32,)


class WaveField(nn.Module):
    frequencies: Tensor

    def __init__(self, config: WaveConfig, bounds: SceneBounds) -> None:
        super().__init__()
        self.bounds = bounds
        self.register_buffer("frequencies", 3 * torch.randn(3, config.waves))
        self.register_buffer("width", torch.tensor(1.0))
        widths = [2 * config.waves + 3, *config.layers]
        layers = [m for a, b in pairwise(widths) for m in (nn.Linear(a, b), nn.Softplus())]
        self.network = nn.Sequential(*layers, nn.Linear(widths[-1], 4))
        self.sampler: Any = Stratified(config.samples)

    def query(self, positions: Tensor, directions: Tensor) -> FieldValues:
        phases = positions @ self.frequencies
        out = self.network(torch.cat([phases.sin(), phases.cos(), 0.1 * directions], dim=-1))
        return FieldValues(nn.functional.softplus(out[..., 0]) * self.width, out[..., 1:].sigmoid())


class PlainWaves:
    """Waves trained by the colours of the images alone."""

    summary: Any = "waves for tests"
    config_type: Any = WaveConfig
    field_type = WaveField

    def build(self, config: Any, bounds: SceneBounds) -> Any:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(config.seed)
            return self.field_type(config, bounds)

    def train(self, field: Any, views: Sequence[View], config: Any, report: Report) -> None:
        bank = RayBank(views, field.bounds, device_of(field))

        def outcome(step: int, generator: Generator) -> StepOutcome:
            batch = bank.draw(256, generator)
            error = (
                (render(field, batch.rays, batch.background, generator).rgb - batch.observed.rgb)
                .square()
                .mean()
            )
            return StepOutcome(error, float(error.detach()))

        groups = [{"params": list(field.parameters()), "lr": 0.02}]
        fit(field, groups, outcome, config.steps, report, schedule=lambda step, total: 1.0, seed=config.seed)


class WaveBackend(PlainWaves):
    """Waves trained as the bundled backends are."""

    def train(self, field: Any, views: Sequence[View], config: Any, report: Report) -> None:
        supervision = Supervision(views, field.bounds, SupervisionConfig(), device_of(field))

        def outcome(step: int, generator: Generator) -> StepOutcome:
            return supervision.step(field, 256, generator)

        groups = [{"params": list(field.parameters()), "lr": 0.02}]
        supervision.fit(
            field, groups, outcome, config.steps, report, schedule=lambda step, total: 1.0, seed=config.seed
        )


class TestWaves(BackendContract):
    backend = WaveBackend()


def fault(check: str, backend: Any, **more: Any) -> str:
    """What the contract's test of that name says of a backend."""
    contract = type("Contract", (BackendContract,), {"backend": backend, **more})()
    with pytest.raises(AssertionError) as caught:
        getattr(contract, check)()
    return str(caught.value)


def with_field(**methods: Any) -> Any:
    """A backend whose field differs from the good one's in the given members."""
    broken = type("BrokenField", (WaveField,), methods)
    return type("BrokenBackend", (WaveBackend,), {"field_type": broken})()


def with_query(change: Callable[[Any, Tensor, Tensor], FieldValues]) -> Any:
    return with_field(query=change)


def with_sampler(sampler: Callable[[Rays, Generator | None], RaySamples]) -> Any:
    def start(self: Any, config: Any, bounds: SceneBounds) -> None:
        WaveField.__init__(self, config, bounds)
        self.sampler = sampler

    return with_field(__init__=start)


def with_members(**members: Any) -> Any:
    return type("BrokenBackend", (WaveBackend,), members)()


good = WaveField.query
sampled = Stratified(16)


# What the entry point names.


def test_a_backend_must_be_named() -> None:
    assert "neither backend nor name" in fault("test_build_gives_a_field", None)


def test_a_backend_may_be_given_by_the_name_of_its_entry_point() -> None:
    by_name = type("Contract", (BackendContract,), {"name": "hashgrid", "config": TestHashGrid.config})
    by_name().test_build_gives_a_field()


def test_lacking_methods_are_told() -> None:
    assert "lacks some of summary, config_type, build, train" in fault(
        "test_backend_says_what_it_is", object()
    )


@pytest.mark.parametrize("summary", ["", "two\nlines", 3])
def test_the_summary_is_one_line(summary: Any) -> None:
    assert "expected one line of text" in fault("test_backend_says_what_it_is", with_members(summary=summary))


@dataclass
class Melted:
    steps: int = 3


@dataclass(frozen=True)
class Bare:
    size: int
    steps: int = 3


@dataclass(frozen=True)
class Endless:
    size: int = 3


@dataclass(frozen=True)
class Halves:
    steps: float = 3.5


CONFIG = "test_config_is_a_frozen_dataclass_with_defaults_and_steps"


@pytest.mark.parametrize(
    ("kind", "said"),
    [
        (dict, "expected a dataclass"),
        (Melted, "not frozen"),
        (Bare, "no default for size"),
        (Endless, "steps = None"),
        (Halves, "steps = 3.5"),
    ],
)
def test_config_types_are_judged(kind: Any, said: str) -> None:
    assert said in fault(CONFIG, with_members(config_type=kind))


@dataclass(frozen=True)
class Unwritable:
    steps: int = 3
    device: Any = field(default_factory=lambda: torch.device("cpu"))


@dataclass(frozen=True)
class Forgetful:
    steps: int = 3
    values: Any = (1, 2)  # comes back as a list


@pytest.mark.parametrize(
    ("kind", "said"), [(Unwritable, "config.device is a device"), (Forgetful, "comes back from JSON")]
)
def test_config_must_survive_json(kind: Any, said: str) -> None:
    assert said in fault("test_config_survives_json", with_members(config_type=kind))


def test_build_must_give_a_module_with_query_and_sampler() -> None:
    no_module = with_members(build=lambda self, config, bounds: object())
    no_field = with_members(build=lambda self, config, bounds: nn.Linear(3, 4))
    assert "expected an nn.Module" in fault("test_build_gives_a_field", no_module)
    assert "without query or sampler" in fault("test_build_gives_a_field", no_field)


def test_build_must_not_draw_from_the_global_generator() -> None:
    broken = with_members(build=lambda self, config, bounds: WaveField(config, bounds))
    assert "differs between two builds of one config" in fault("test_build_is_reproducible", broken)


# What the field says.


def flattened(self: Any, positions: Tensor, directions: Tensor) -> FieldValues:
    return good(self, positions.reshape(-1, 3), directions.reshape(-1, 3))


def no_zero(self: Any, positions: Tensor, directions: Tensor) -> FieldValues:
    float(positions.max())
    return good(self, positions, directions)


def batch_norm(self: Any, positions: Tensor, directions: Tensor) -> FieldValues:
    flat = positions.reshape(-1, 3)
    return good(self, positions - flat.mean(0) if len(flat) else positions, directions)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (flattened, "density has shape (1,), expected ()"),
        (no_zero, "query of points arranged as (0,) raised"),
        (batch_norm, "expected each point's value to depend on that point alone"),
    ],
)
def test_shapes_are_judged(change: Any, said: str) -> None:
    assert said in fault("test_query_takes_any_shape", with_query(change))


def changed(**of: Callable[[Tensor, Tensor], Tensor]) -> Any:
    """A query whose density or rgb is changed, knowing the positions."""

    def query(self: Any, positions: Tensor, directions: Tensor) -> FieldValues:
        values = good(self, positions, directions)
        return replace(values, **{k: change(getattr(values, k), positions) for k, change in of.items()})

    return with_query(query)


def far(positions: Tensor) -> Tensor:
    return positions.norm(dim=-1) > 100


@pytest.mark.parametrize(
    ("backend", "said"),
    [
        (changed(density=lambda d, p: d - 5), "expected 0 or more"),
        (changed(rgb=lambda c, p: 4 * c), "expected 0 to 1"),
        (changed(rgb=lambda c, p: c - 0.5), "expected 0 to 1"),
        (changed(density=lambda d, p: torch.where(far(p), torch.nan, d)), "far outside the box: density is NaN"),
        (changed(rgb=lambda c, p: c.where(~far(p)[..., None], c / 0)), "far outside the box: rgb is NaN"),
    ],
)  # fmt: skip
def test_ranges_are_judged(backend: Any, said: str) -> None:
    assert said in fault("test_query_is_finite_and_in_range", backend)


def test_an_index_out_of_range_is_told() -> None:
    def grid(self: Any, positions: Tensor, directions: Tensor) -> FieldValues:
        torch.zeros(9)[((positions[..., 0] + 1) * 4).long()]
        return good(self, positions, directions)

    said = fault("test_query_is_finite_and_in_range", with_query(grid))
    assert "query of points far outside the box raised IndexError" in said


def detached_position(self: Any, positions: Tensor, directions: Tensor) -> FieldValues:
    return good(self, positions.detach(), directions)


def detached_direction(self: Any, positions: Tensor, directions: Tensor) -> FieldValues:
    return good(self, positions, directions.detach())


def without_grad(self: Any, positions: Tensor, directions: Tensor) -> FieldValues:
    with torch.no_grad():
        return good(self, positions, directions)


class Doubling(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, value: Tensor) -> Tensor:
        return value.clone()

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        return 2 * gradient


def wrong_derivative(self: Any, positions: Tensor, directions: Tensor) -> FieldValues:
    return good(self, Doubling.apply(positions), Doubling.apply(directions))


@pytest.mark.parametrize("change", [detached_position, without_grad, wrong_derivative])
def test_derivatives_by_position_are_judged(change: Any) -> None:
    said = fault("test_query_is_differentiable_by_position", with_query(change))
    assert "the derivative of density by position agrees with finite differences at" in said


@pytest.mark.parametrize("change", [detached_direction, without_grad, wrong_derivative])
def test_derivatives_by_direction_are_judged(change: Any) -> None:
    said = fault("test_query_is_differentiable_by_direction", with_query(change))
    assert "by direction agrees with finite differences at" in said


def test_a_field_that_ignores_the_direction_is_fine() -> None:
    def same(self: Any, positions: Tensor, directions: Tensor) -> FieldValues:
        return good(self, positions, torch.zeros_like(directions))

    type("C", (BackendContract,), {"backend": with_query(same)})().test_query_is_differentiable_by_direction()


def test_derivatives_are_compared_in_float32_where_there_is_no_other() -> None:
    def single(self: Any, positions: Tensor, directions: Tensor) -> FieldValues:
        if positions.dtype != torch.float32:
            raise TypeError("float32 only")
        return good(self, positions, directions)

    def single_wrong(self: Any, positions: Tensor, directions: Tensor) -> FieldValues:
        return single(self, Doubling.apply(positions), directions)

    fine = type("C", (BackendContract,), {"backend": with_query(single)})()
    fine.test_query_is_differentiable_by_position()
    fine.test_query_is_differentiable_by_direction()
    assert "finite differences" in fault("test_query_is_differentiable_by_position", with_query(single_wrong))


def in_float32(self: Any, positions: Tensor, directions: Tensor) -> FieldValues:
    values = good(self, positions, directions)
    return FieldValues(values.density.float(), values.rgb.float())


def in_float64(self: Any, positions: Tensor, directions: Tensor) -> FieldValues:
    values = good(self, positions, directions)
    return FieldValues(values.density.double(), values.rgb.double())


def other_in_float64(self: Any, positions: Tensor, directions: Tensor) -> FieldValues:
    return good(self, positions + (positions.dtype == torch.float64), directions)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (in_float32, "density is torch.float32, expected float64"),
        (in_float64, "density is torch.float64 for points in float32"),
        (other_in_float64, "is another than in float32"),
    ],
)
def test_dtypes_are_judged(change: Any, said: str) -> None:
    assert said in fault("test_query_follows_the_dtype", with_query(change))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA device")
def test_constants_that_stay_on_the_cpu_are_told() -> None:
    offset = torch.full((3,), 0.1)

    def stays(self: Any, positions: Tensor, directions: Tensor) -> FieldValues:
        return good(self, positions + offset, directions)

    assert "on CUDA raised" in fault("test_field_moves_to_a_device", with_query(stays))


def test_state_between_threads_is_told() -> None:
    def careless(self: Any, positions: Tensor, directions: Tensor) -> FieldValues:
        self.kept = (positions, directions)
        time.sleep(0.001)
        return good(self, *self.kept)

    said = fault("test_query_serves_several_threads", with_query(careless))
    assert "threads" in said


# Where the field is asked.


def reverse(rays: Rays, jitter: Generator | None = None) -> RaySamples:
    s = sampled(rays, jitter)
    return RaySamples(s.starts.flip(-1), s.ends.flip(-1), s.valid)


def wide(rays: Rays, jitter: Generator | None = None) -> RaySamples:
    s = sampled(rays, jitter)
    return RaySamples(s.starts, s.ends + 0.1, s.valid)


def beyond(rays: Rays, jitter: Generator | None = None) -> RaySamples:
    s = sampled(rays, jitter)
    return RaySamples(s.starts + 0.1, s.ends + 0.1, s.valid)


def always(rays: Rays, jitter: Generator | None = None) -> RaySamples:
    s = sampled(rays, jitter)
    return RaySamples(s.starts, s.ends, torch.ones_like(s.valid))


def infinite(rays: Rays, jitter: Generator | None = None) -> RaySamples:
    s = sampled(rays, jitter)
    return RaySamples(s.starts.where(s.valid, torch.inf), s.ends.where(s.valid, torch.inf), s.valid)


def one_axis(rays: Rays, jitter: Generator | None = None) -> RaySamples:
    flat = Rays(
        *(
            x.reshape(-1, *x.shape[rays.near.ndim :])
            for x in (rays.origins, rays.directions, rays.near, rays.far)
        )
    )
    return sampled(flat, jitter)


def not_bool(rays: Rays, jitter: Generator | None = None) -> RaySamples:
    s = sampled(rays, jitter)
    made = object.__new__(RaySamples)
    for name, value in (("starts", s.starts), ("ends", s.ends), ("valid", s.valid.float())):
        object.__setattr__(made, name, value)
    return made


def longest(rays: Rays, jitter: Generator | None = None) -> RaySamples:
    float(rays.far.max())
    return sampled(rays, jitter)


@pytest.mark.parametrize(
    ("sampler", "said"),
    [
        (reverse, "not sorted, expected nearest first"),
        (wide, "overlap"),
        (beyond, "lies outside [near, far]"),
        (always, "a ray with far <= near has valid samples"),
        (infinite, "NaN or infinite"),
        (one_axis, "expected the same for all three: () and one more axis"),
        (not_bool, "expected torch.bool"),
        (longest, "rays arranged as (0,) raised"),
    ],
)
def test_samplers_are_judged(sampler: Any, said: str) -> None:
    assert said in fault("test_samples_are_sorted_disjoint_and_on_the_ray", with_sampler(sampler))


def chance(rays: Rays, jitter: Generator | None = None) -> RaySamples:
    return sampled(rays, torch.Generator().manual_seed(int(torch.randint(1 << 30, ()))))


def global_jitter(rays: Rays, jitter: Generator | None = None) -> RaySamples:
    return sampled(rays) if jitter is None else chance(rays)


@pytest.mark.parametrize(
    ("sampler", "said"),
    [
        (chance, "two calls without jitter differ"),
        (global_jitter, "two calls with jitter of the same seed differ"),
    ],
)
def test_chance_in_samplers_is_told(sampler: Any, said: str) -> None:
    assert said in fault("test_samples_are_repeatable", with_sampler(sampler))


def common_far(rays: Rays, jitter: Generator | None = None) -> RaySamples:
    """All rays as long as the shortest of them."""
    hit = rays.far > rays.near
    length = (rays.far - rays.near)[hit].min() if bool(hit.any()) else torch.tensor(0.0)
    return sampled(replace(rays, far=torch.minimum(rays.far, rays.near + length)), jitter)


def by_place(rays: Rays, jitter: Generator | None = None) -> RaySamples:
    """Rays in odd places of the batch see half as far."""
    odd = (torch.arange(rays.near.numel()) % 2).reshape(rays.near.shape)
    return sampled(replace(rays, far=rays.far - odd * (rays.far - rays.near) / 2), jitter)


@pytest.mark.parametrize(
    ("sampler", "said"),
    [(common_far, "expected each ray to be sampled for itself"), (by_place, "in another order")],
)
def test_rays_that_depend_on_each_other_are_told(sampler: Any, said: str) -> None:
    assert said in fault("test_rays_do_not_depend_on_each_other", with_sampler(sampler))


def test_matter_beyond_the_scene_is_told() -> None:
    def stretched(rays: Rays, jitter: Generator | None = None) -> RaySamples:
        return sampled(replace(rays, far=rays.far + 1), jitter)

    said = fault("test_rays_that_miss_see_the_background", with_sampler(stretched))
    assert "does not see the background alone" in said


@dataclass(frozen=True)
class HalfSamples:
    whole: Any

    @property
    def sampler(self) -> Stratified:
        return Stratified(8)

    def query(self, positions: Tensor, directions: Tensor) -> FieldValues:
        return self.whole.query(positions, directions)


def test_levels_are_judged() -> None:
    backwards = with_field(levels=property(lambda self: (self, HalfSamples(self))))
    no_field = with_field(levels=property(lambda self: ("coarse", self)))
    said = fault("test_levels_are_fields_coarsest_first", backwards)
    assert "the last one renders otherwise than the field itself" in said
    assert "levels[0] is a str, expected a field" in fault("test_levels_are_fields_coarsest_first", no_field)


class TestWithLevels(BackendContract):
    backend = with_field(levels=property(lambda self: (HalfSamples(self), self)))


def test_laws_hold_for_every_level() -> None:
    @dataclass(frozen=True)
    class Negative(HalfSamples):
        def query(self, positions: Tensor, directions: Tensor) -> FieldValues:
            values = self.whole.query(positions, directions)
            return replace(values, density=values.density - 5)

    broken = with_field(levels=property(lambda self: (Negative(self), self)))
    said = fault("test_query_is_finite_and_in_range", broken)
    assert said.startswith("Negative.query")
    assert "expected 0 or more" in said


def nowhere(self: Any, positions: Tensor, directions: Tensor) -> FieldValues:
    return good(self, positions.detach(), directions.detach())


@pytest.mark.parametrize(("change", "said"), [(nowhere, "no gradient"), (without_grad, "no gradient")])
def test_poses_without_gradient_are_told(change: Any, said: str) -> None:
    broken = with_query(change)
    broken.train = lambda *arguments: None
    assert said in fault("test_rendering_carries_gradients_to_the_pose", broken)


def read_by_the_host(self: Any, positions: Tensor, directions: Tensor) -> FieldValues:
    values = good(self, positions, directions)
    assert float(values.density.detach().min()) >= 0
    return values


def chosen_by_a_mask(self: Any, positions: Tensor, directions: Tensor) -> FieldValues:
    values = good(self, positions, directions)
    dense = values.density > 0
    return replace(values, rgb=torch.zeros_like(values.rgb).index_put((dense,), values.rgb[dense]))


@pytest.mark.parametrize(
    ("change", "said"), [(read_by_the_host, "reads a number"), (chosen_by_a_mask, "depends on values")]
)
def test_steps_that_wait_for_the_device_are_told(change: Any, said: str) -> None:
    broken = with_query(change)
    broken.train = lambda *arguments: None
    assert said in fault("test_steps_stay_on_the_device", broken)


# What is saved.


class PlainState(WaveField):
    """Keeps in a plain attribute what training changes."""

    def __init__(self, config: Any, bounds: SceneBounds) -> None:
        super().__init__(config, bounds)
        self.scale = 1.0

    def query(self, positions: Tensor, directions: Tensor) -> FieldValues:
        values = super().query(positions, directions)
        return replace(values, density=self.scale * values.density)


class PlainBackend(WaveBackend):
    field_type = PlainState

    def train(self, field: Any, views: Sequence[View], config: Any, report: Report) -> None:
        super().train(field, views, config, report)
        field.scale = 2.0


def test_state_beside_the_state_dict_is_told() -> None:
    assert "is some state not in state_dict" in fault("test_saved_field_renders_the_same", PlainBackend())


def test_tensors_that_do_not_load_are_told() -> None:
    class Growing(WaveBackend):
        def train(self, field: Any, views: Sequence[View], config: Any, report: Report) -> None:
            field.register_buffer("late", torch.zeros(3))

    assert "load_state_dict of a saved state_dict raised" in fault(
        "test_saved_field_renders_the_same", Growing()
    )


# How it is trained.


class Lazy(WaveBackend):
    """Trains a copy."""

    def train(self, field: Any, views: Sequence[View], config: Any, report: Report) -> None:
        super().train(self.build(config, field.bounds), views, config, report)


def test_recipes_that_learn_nothing_are_told() -> None:
    for check in ("test_training_learns_from_rgbd", "test_training_learns_from_rgb"):
        assert "does the recipe change the field" in fault(check, Lazy())


def test_recipes_that_need_depth_are_told() -> None:
    class Needy(WaveBackend):
        def train(self, field: Any, views: Sequence[View], config: Any, report: Report) -> None:
            for view in views:
                assert view.frame.depth is not None
            super().train(field, views, config, report)

    type("C", (BackendContract,), {"backend": Needy()})().test_training_learns_from_rgbd()
    broken = type("Needier", (Needy,), {"train": lambda self, f, views, c, r: views[0].frame.depth.mean()})()
    assert "train on RGB views raised AttributeError" in fault("test_training_learns_from_rgb", broken)


class Listener:
    """Stands between a recipe and its report."""

    def __init__(self, report: Report, **changes: Any) -> None:
        self._report, self._changes = report, changes

    def __getattr__(self, name: str) -> Any:
        return self._changes[name] if name in self._changes else getattr(self._report, name)


def by_a_ray_bank(self: Any, field: Any, views: Sequence[View], config: Any, report: Report) -> None:
    """A recipe of colour and depth that knows of no exposure."""
    bank = RayBank(views, field.bounds, device_of(field))

    def outcome(step: int, generator: Generator) -> StepOutcome:
        batch = bank.draw(256, generator)
        rendering = render(field, batch.rays, batch.background, generator)
        return StepOutcome(*supervised_loss(rendering, batch, field.bounds.side, 0.1))

    fit(field, [{"params": list(field.parameters()), "lr": 0.02}], outcome, config.steps, report)


@pytest.mark.parametrize("backend", [PlainWaves(), with_members(train=by_a_ray_bank)])
def test_recipes_that_ignore_exposure_are_named(backend: Any) -> None:
    said = fault("test_training_learns_the_exposure_of_images", backend)
    assert "of the images' exposures went into the colours of the field, expected 6% or less" in said
    assert "train with bidnerf_core.training.Supervision" in said


def reporting(**changes: Callable[[Report], Any]) -> Any:
    """A backend whose recipe hears or says something else."""

    class Broken(WaveBackend):
        def train(self, field: Any, views: Sequence[View], config: Any, report: Report) -> None:
            heard = {name: change(report) for name, change in changes.items()}
            super().train(field, views, config, Listener(report, **heard))  # type: ignore[arg-type]

    return Broken()


def every_other(report: Report) -> Any:
    return lambda progress: report.step(progress) if progress.step % 2 else None


def nan_loss(report: Report) -> Any:
    return lambda progress: report.step(replace(progress, loss=float("nan")))


def stale_save(report: Report) -> Any:
    return lambda state: report.save(replace(state, field={k: 0 * v for k, v in state.field.items()}))


@pytest.mark.parametrize(
    ("backend", "said"),
    [
        (reporting(step=every_other), "report.step was called with [(1, 60), (3, 60)"),
        (reporting(step=nan_loss), "loss or PSNR that is not finite"),
        (reporting(due=lambda report: lambda step: False), "saved after steps [], expected [1, 30, 60]"),
        (reporting(due=lambda report: lambda step: True), "exactly when"),
        (reporting(save=stale_save), "not that of the trained field"),
    ],
)
def test_reports_are_judged(backend: Any, said: str) -> None:
    assert said in fault("test_training_reports_and_saves", backend, config=WaveConfig())


class Deaf(WaveBackend):
    """Stops, but too late and without a word."""

    def train(self, field: Any, views: Sequence[View], config: Any, report: Report) -> None:
        try:
            super().train(field, views, config, report)
        except TrainingStopped as stopped:
            raise TrainingStopped(stopped.step + 1) from stopped


class Forgetting(WaveBackend):
    """Uses the global generator."""

    def train(self, field: Any, views: Sequence[View], config: Any, report: Report) -> None:
        with torch.no_grad():
            field.width.add_(0.1 * torch.rand(()))
        super().train(field, views, config, report)


@pytest.mark.parametrize(
    ("backend", "said"),
    [
        (reporting(stopping=lambda report: False), "did not stop when report.stopping was set after step 30"),
        (Deaf(), "TrainingStopped says step 31"),
        (
            reporting(resume=lambda report: lambda: None),
            "resumed after step 30, it reported steps [1, 2, ... 60]",
        ),
        (Forgetting(), "a resumed training arrives elsewhere"),
    ],
)
def test_stopping_and_resuming_are_judged(backend: Any, said: str) -> None:
    assert said in fault("test_training_stops_and_resumes", backend, config=WaveConfig())


def test_hits_that_stop_other_light_than_the_density_are_told() -> None:
    def opaque(self: Any, rays: Rays) -> RayHits:
        near = rays.near[..., None]
        valid = (rays.far > rays.near)[..., None]
        return RayHits(near, valid.to(near), torch.ones((*near.shape, 3)), valid)

    assert "of the light of rays" in fault("test_hits_agree_with_the_density", with_field(hits=opaque))


@pytest.mark.slow
def test_the_contract_does_not_need_pytest() -> None:
    code = "import sys; sys.modules['pytest'] = None; from bidnerf_core.testing import BackendContract"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_every_check_has_a_backend_that_breaks_it() -> None:
    source = Path(__file__).read_text(encoding="utf-8")
    checks = [name for name in dir(BackendContract) if name.startswith("test_")]
    assert [name for name in checks if f'"{name}"' not in source] == []
