"""The contract for backends: good ones keep it, and each way of breaking it is told by its name."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, make_dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Generator, Tensor, nn

import bidnerf.testing
import bidnerf_core
import tiny
from bidnerf.testing import BackendContract
from bidnerf_core.fields import (
    FieldDerivatives,
    FieldValues,
    RayHits,
    Rays,
    RaySamples,
    SceneBounds,
    Stratified,
    backward_derivatives,
    device_of,
    render,
)
from bidnerf_core.frames import View
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
from simulated_device import StaysOnDevice

CHECKS = [name for name in dir(BackendContract) if name.startswith("test_")]


class TestHashGrid(StaysOnDevice, BackendContract):
    backend = hashgrid
    config = tiny.config(steps=30, learning_rate=0.1, samples_per_step=1024)


@dataclass(frozen=True)
class WaveConfig:
    """A few sine waves through a linear layer: the least that learns."""

    steps: int = 60
    waves: int = 32
    samples: int = 16
    seed: int = 0
    layers: tuple[int, ...] = (32,)


@dataclass(frozen=True)
class Untyped:
    waves = 32
    steps: int = 60


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
            rgb = render(field, batch.rays, batch.background, generator).rgb
            error = (rgb - batch.observed.rgb).square().mean()
            return StepOutcome(error, float(error.detach()))

        groups = [{"params": list(field.parameters()), "lr": 0.02}]
        fit(field, groups, outcome, config.steps, report, schedule=lambda step, total: 1.0, seed=config.seed)


class WaveBackend(PlainWaves):
    """Waves trained as the bundled backends are."""

    def train(self, field: Any, views: Sequence[View], config: Any, report: Report) -> None:
        supervision = Supervision(views, field.bounds, SupervisionConfig(), device_of(field))
        supervision.fit(
            field,
            [{"params": list(field.parameters()), "lr": 0.02}],
            lambda step, generator: supervision.step(field, 256, generator),
            config.steps,
            report,
            schedule=lambda step, total: 1.0,
            seed=config.seed,
        )


class TestWaves(StaysOnDevice, BackendContract):
    backend = WaveBackend()


# Backends that differ from the good one in one thing.


good = WaveField.query
sampled = Stratified(16)
Changed = Callable[..., Any]


def with_members(**members: Any) -> Any:
    return type("BrokenBackend", (WaveBackend,), members)()


def with_field(**members: Any) -> Any:
    return with_members(field_type=type("BrokenField", (WaveField,), members))


def asked(change: Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]) -> Any:
    """Its field is asked about changed positions and directions."""
    return with_field(query=lambda self, positions, directions: good(self, *change(positions, directions)))


def answered(change: Callable[[FieldValues, Tensor], FieldValues]) -> Any:
    """Its field's values are changed, knowing the positions."""
    return with_field(query=lambda self, positions, directions: change(good(self, positions, directions), positions))


def by_sampler(sampler: Callable[[Rays, Generator | None], RaySamples]) -> Any:
    def start(self: Any, config: Any, bounds: SceneBounds) -> None:
        WaveField.__init__(self, config, bounds)
        self.sampler = sampler

    return with_field(__init__=start)


def along(change: Callable[[Rays], Rays]) -> Any:
    """It samples changed rays."""
    return by_sampler(lambda rays, jitter=None: sampled(change(rays), jitter))  # type: ignore[misc]


def taken(change: Callable[[RaySamples], RaySamples]) -> Any:
    """It changes the samples."""
    return by_sampler(lambda rays, jitter=None: change(sampled(rays, jitter)))  # type: ignore[misc]


def untrained(backend: Any) -> Any:
    """Its training, which would fail as well, does nothing."""
    backend.train = lambda *arguments: None
    return backend


def config(name: str, *fields: Any, frozen: bool = True) -> Any:
    """A backend whose config has these fields: names, types and perhaps defaults."""
    return with_members(config_type=make_dataclass(name, fields, frozen=frozen))


STEPS = ("steps", int, 3)


class Doubling(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, value: Tensor) -> Tensor:
        return value.clone()

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        return 2 * gradient


def far(positions: Tensor) -> Tensor:
    return positions.norm(dim=-1) > 100


def with_no_grad(self: Any, positions: Tensor, directions: Tensor) -> FieldValues:
    with torch.no_grad():
        return good(self, positions, directions)


def single(positions: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
    if positions.dtype != torch.float32:
        raise TypeError("float32 only")
    return positions, directions


def careless(self: Any, positions: Tensor, directions: Tensor) -> FieldValues:
    self.kept = (positions, directions)
    time.sleep(0.001)
    return good(self, *self.kept)


def steeper(self: Any, positions: Tensor, directions: Tensor, wanted: Tensor | None = None) -> FieldDerivatives:
    found = backward_derivatives(self.query, positions, directions)
    return replace(found, by_position=1.01 * found.by_position)


def as_long_as_the_shortest(rays: Rays) -> Rays:
    hit = rays.far > rays.near
    length = (rays.far - rays.near)[hit].min() if bool(hit.any()) else torch.tensor(0.0)
    return replace(rays, far=torch.minimum(rays.far, rays.near + length))


def by_place(rays: Rays) -> Rays:
    """Rays in odd places of the batch see half as far."""
    odd = (torch.arange(rays.near.numel()) % 2).reshape(rays.near.shape)
    return replace(rays, far=rays.far - odd * (rays.far - rays.near) / 2)


def not_bool(s: RaySamples) -> RaySamples:
    made = object.__new__(RaySamples)
    for name, value in (("starts", s.starts), ("ends", s.ends), ("valid", s.valid.float())):
        object.__setattr__(made, name, value)
    return made


def chance(rays: Rays, jitter: Generator | None = None) -> RaySamples:
    return sampled(rays, torch.Generator().manual_seed(int(torch.randint(1 << 30, ()))))


def opaque(self: Any, rays: Rays) -> RayHits:
    near, valid = rays.near[..., None], (rays.far > rays.near)[..., None]
    return RayHits(near, valid.to(near), torch.ones((*near.shape, 3)), valid)


@dataclass(frozen=True)
class HalfSamples:
    whole: Any

    @property
    def sampler(self) -> Stratified:
        return Stratified(8)

    def query(self, positions: Tensor, directions: Tensor) -> FieldValues:
        return self.whole.query(positions, directions)  # type: ignore[no-any-return]


class Negative(HalfSamples):
    def query(self, positions: Tensor, directions: Tensor) -> FieldValues:
        values = self.whole.query(positions, directions)
        return replace(values, density=values.density - 5)


def with_levels(levels: Callable[[Any], tuple[Any, ...]]) -> Any:
    return with_field(levels=property(levels))


class PlainState(WaveField):
    """Keeps in a plain attribute what training changes."""

    scale = 1.0

    def query(self, positions: Tensor, directions: Tensor) -> FieldValues:
        values = super().query(positions, directions)
        return replace(values, density=self.scale * values.density)


def trained_by(before: Changed = lambda *given: None, after: Changed = lambda *given: None, **members: Any) -> Any:
    """Its recipe does something with what it is given before the good recipe or after it."""

    class Broken(WaveBackend):
        def train(self, field: Any, views: Sequence[View], config: Any, report: Report) -> None:
            before(field, views, config, report)
            super().train(field, views, config, report)
            after(field, views, config, report)

    return type("BrokenBackend", (Broken,), members)()


class Lazy(WaveBackend):
    """Trains a copy."""

    def train(self, field: Any, views: Sequence[View], config: Any, report: Report) -> None:
        super().train(self.build(config, field.bounds), views, config, report)


class Listener:
    """Stands between a recipe and its report."""

    def __init__(self, report: Report, changes: dict[str, Any]) -> None:
        self._report, self._changes = report, changes

    def __getattr__(self, name: str) -> Any:
        return self._changes[name] if name in self._changes else getattr(self._report, name)


def reporting(**changes: Callable[[Report], Any]) -> Any:
    """A backend whose recipe hears or says something else."""

    class Broken(WaveBackend):
        def train(self, field: Any, views: Sequence[View], config: Any, report: Report) -> None:
            heard = Listener(report, {name: change(report) for name, change in changes.items()})
            super().train(field, views, config, heard)  # type: ignore[arg-type]

    return Broken()


def by_a_ray_bank(self: Any, field: Any, views: Sequence[View], config: Any, report: Report) -> None:
    """A recipe of colour and depth that knows of no exposure."""
    bank = RayBank(views, field.bounds, device_of(field))

    def outcome(step: int, generator: Generator) -> StepOutcome:
        batch = bank.draw(256, generator)
        rendering = render(field, batch.rays, batch.background, generator)
        return StepOutcome(*supervised_loss(rendering, batch, field.bounds.side, 0.1))

    fit(field, [{"params": list(field.parameters()), "lr": 0.02}], outcome, config.steps, report)


class Deaf(WaveBackend):
    """Stops, but too late and without a word."""

    def train(self, field: Any, views: Sequence[View], config: Any, report: Report) -> None:
        try:
            super().train(field, views, config, report)
        except TrainingStopped as stopped:
            raise TrainingStopped(stopped.step + 1) from stopped


# Each way of breaking the contract, and what its test says of it.


SAYS, JSON = "test_backend_says_what_it_is", "test_config_survives_json"
BUILD, SHAPES, RANGES = (
    "test_build_gives_a_field",
    "test_query_takes_any_shape",
    "test_query_is_finite_and_in_range",
)
POSITION, DIRECTION = "test_query_is_differentiable_by_position", "test_query_is_differentiable_by_direction"
JACOBIAN = "test_jacobian_is_the_derivative_of_query"
DTYPE, INTERVALS = "test_query_follows_the_dtype", "test_samples_are_sorted_disjoint_and_on_the_ray"
REPEATABLE, ALONE = "test_samples_are_repeatable", "test_rays_do_not_depend_on_each_other"
LEVELS, POSE, SAVED = (
    "test_levels_are_fields_coarsest_first",
    "test_rendering_carries_gradients_to_the_pose",
    "test_saved_field_renders_the_same",
)
RGB, EXPOSURE = "test_training_learns_from_rgb", "test_training_learns_the_exposure_of_images"
REPORTS, RESUMES = "test_training_reports_and_saves", "test_training_stops_and_resumes"
DIFFERENCES = "agrees with finite differences at"
RISES = "the derivative of density by position " + DIFFERENCES
ABSORBED = "of the images' exposures went into the colours of the field, expected 6% or less"
NO_CUDA = pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA device")
cpu_offset = torch.full((3,), 0.1)

BREAKS: list[tuple[str, Any, str]] = [
    (BUILD, None, "neither backend nor name"),
    (SAYS, object(), "object has no summary, config_type, build, train"),
    *((SAYS, with_members(summary=text), "expected one line of text") for text in ("", "two\nlines", 3)),
    (SAYS, with_members(config_type=dict), "config_type is <class 'dict'>, expected a frozen dataclass"),
    (SAYS, config("Melted", STEPS, frozen=False), "Melted'>, expected a frozen dataclass"),
    (SAYS, config("Bare", ("size", int), STEPS), "no default for size"),
    *((test, config("Endless", ("size", int, 3)), "Endless has no field steps") for test in (SAYS, SHAPES)),
    (SAYS, config("Halves", ("steps", float, 3.5)), "steps = 3.5"),
    (SAYS, with_members(config_type=Untyped), "has no type for waves, expected 'waves: int = 32'"),
    (
        JSON,
        config("Unwritable", STEPS, ("device", Any, field(default=torch.device("cpu")))),
        "config.device is a device",
    ),
    (JSON, config("Forgetful", STEPS, ("values", Any, (1, 2))), "comes back from JSON"),
    (BUILD, with_members(build=lambda self, config, bounds: object()), "expected an nn.Module"),
    (BUILD, with_members(build=lambda self, config, bounds: nn.Linear(3, 4)), "without query or sampler"),
    (
        "test_build_is_reproducible",
        with_members(build=lambda self, config, bounds: WaveField(config, bounds)),
        "differs between two builds of one config",
    ),
    # What the field says.
    (RGB, answered(lambda v, p: replace(v, density=v.density[..., None])), "density has shape (2, 1), expected (2,)"),
    (SHAPES, asked(lambda p, d: (p.reshape(-1, 3), d.reshape(-1, 3))), "density has shape (1,), expected ()"),
    (SHAPES, asked(lambda p, d: (p + 0 * float(p.max()), d)), "query of points arranged as (0,) raised"),
    (SHAPES, asked(lambda p, d: (p - p.reshape(-1, 3).mean(0) if p.numel() else p, d)), "depend on that point alone"),
    (RANGES, answered(lambda v, p: replace(v, density=v.density - 5)), "expected 0 or more"),
    (RANGES, answered(lambda v, p: replace(v, rgb=4 * v.rgb)), "expected 0 to 1"),
    (RANGES, answered(lambda v, p: replace(v, rgb=v.rgb - 0.5)), "expected 0 to 1"),
    (
        RANGES,
        answered(lambda v, p: replace(v, density=torch.where(far(p), torch.nan, v.density))),
        "far outside the box: density is NaN",
    ),
    (
        RANGES,
        answered(lambda v, p: replace(v, rgb=v.rgb.where(~far(p)[..., None], v.rgb / 0))),
        "far outside the box: rgb is NaN",
    ),
    (
        RANGES,
        asked(lambda p, d: (p + 0 * torch.zeros(9)[((p[..., 0] + 1) * 4).long()][..., None], d)),
        "far outside the box raised IndexError",
    ),
    (RANGES, with_levels(lambda field: (Negative(field), field)), "Negative.query"),
    (POSITION, asked(lambda p, d: (p.detach(), d)), RISES),
    (POSITION, with_field(query=with_no_grad), RISES),
    (POSITION, asked(lambda p, d: (Doubling.apply(p), d)), RISES),
    (POSITION, asked(lambda p, d: single(Doubling.apply(p), d)), "finite differences"),
    (DIRECTION, asked(lambda p, d: (p, d.detach())), f"by direction {DIFFERENCES}"),
    (DIRECTION, with_field(query=with_no_grad), f"by direction {DIFFERENCES}"),
    (DIRECTION, asked(lambda p, d: (p, Doubling.apply(d))), f"by direction {DIFFERENCES}"),
    (JACOBIAN, with_field(jacobian=steeper), "the derivative by position differs from that of query"),
    (
        DTYPE,
        answered(lambda v, p: FieldValues(v.density.float(), v.rgb.float())),
        "density is torch.float32, expected float64",
    ),
    (
        DTYPE,
        answered(lambda v, p: FieldValues(v.density.double(), v.rgb.double())),
        "density is torch.float64 for points in float32",
    ),
    (DTYPE, asked(lambda p, d: (p + (p.dtype == torch.float64), d)), "is another than in float32"),
    ("test_query_serves_several_threads", with_field(query=careless), "threads"),
    # Where the field is asked.
    (
        INTERVALS,
        taken(lambda s: RaySamples(s.starts.flip(-1), s.ends.flip(-1), s.valid)),
        "not sorted, expected nearest first",
    ),
    (INTERVALS, taken(lambda s: replace(s, ends=s.ends + 0.1)), "overlap"),
    (INTERVALS, taken(lambda s: replace(s, starts=s.starts + 0.1, ends=s.ends + 0.1)), "lies outside [near, far]"),
    (
        INTERVALS,
        taken(lambda s: replace(s, valid=torch.ones_like(s.valid))),
        "a ray with far <= near has valid samples",
    ),
    (
        INTERVALS,
        taken(lambda s: replace(s, starts=s.starts.where(s.valid, torch.inf), ends=s.ends.where(s.valid, torch.inf))),
        "NaN or infinite",
    ),
    (
        INTERVALS,
        along(
            lambda rays: Rays(
                rays.origins.reshape(-1, 3), rays.directions.reshape(-1, 3), rays.near.ravel(), rays.far.ravel()
            )
        ),
        "expected the same for all three: () and one more axis",
    ),
    (INTERVALS, taken(not_bool), "expected torch.bool"),
    (
        INTERVALS,
        along(lambda rays: replace(rays, far=rays.far + 0 * float(rays.far.max()))),
        "rays arranged as (0,) raised",
    ),
    (REPEATABLE, by_sampler(chance), "two calls without jitter differ"),
    (
        REPEATABLE,
        by_sampler(lambda rays, jitter=None: sampled(rays) if jitter is None else chance(rays)),  # type: ignore[misc]
        "two calls with jitter of the same seed differ",
    ),
    (ALONE, along(as_long_as_the_shortest), "expected each ray to be sampled for itself"),
    (ALONE, along(by_place), "in another order"),
    (
        "test_rays_that_miss_see_the_background",
        along(lambda rays: replace(rays, far=rays.far + 1)),
        "does not see the background alone",
    ),
    ("test_hits_agree_with_the_density", with_field(hits=opaque), "of the light of rays"),
    (
        LEVELS,
        with_levels(lambda field: (field, HalfSamples(field))),
        "the last one renders otherwise than the field itself",
    ),
    (LEVELS, with_levels(lambda field: ("coarse", field)), "levels[0] is a str, expected a field"),
    (POSE, untrained(asked(lambda p, d: (p.detach(), d.detach()))), "no gradient"),
    (POSE, untrained(with_field(query=with_no_grad)), "no gradient"),
    # What is saved.
    (
        SAVED,
        trained_by(after=lambda field, *given: setattr(field, "scale", 2.0), field_type=PlainState),
        "is some state not in state_dict",
    ),
    (
        SAVED,
        trained_by(lambda field, *given: field.register_buffer("late", torch.zeros(3))),
        "load_state_dict of a saved state_dict raised",
    ),
    # How it is trained.
    ("test_training_learns_from_rgbd", Lazy(), "does the recipe change the field"),
    (RGB, Lazy(), "does the recipe change the field"),
    (
        RGB,
        trained_by(lambda field, views, *given: views[0].frame.depth.mean()),
        "train on RGB views raised AttributeError",
    ),
    (EXPOSURE, PlainWaves(), ABSORBED),
    (EXPOSURE, with_members(train=by_a_ray_bank), "train with bidnerf_core.training.Supervision"),
    (
        REPORTS,
        reporting(step=lambda report: lambda now: report.step(now) if now.step % 2 else None),
        "report.step was called with [(1, 6), (3, 6)",
    ),
    (
        REPORTS,
        reporting(step=lambda report: lambda now: report.step(replace(now, loss=float("nan")))),
        "loss or PSNR that is not finite",
    ),
    (REPORTS, reporting(due=lambda report: lambda step: False), "saved after steps [], expected [1, 3, 6]"),
    (REPORTS, reporting(due=lambda report: lambda step: True), "exactly when"),
    (
        REPORTS,
        reporting(
            save=lambda report: (
                lambda state: report.save(replace(state, field={k: 0 * v for k, v in state.field.items()}))
            )
        ),
        "not that of the trained field",
    ),
    (RESUMES, reporting(stopping=lambda report: False), "did not stop when report.stopping was set after step 3"),
    (RESUMES, Deaf(), "TrainingStopped says step 4"),
    (RESUMES, reporting(resume=lambda report: lambda: None), "resumed after step 3, it reported steps [1, 2, ... 6]"),
    (
        RESUMES,
        trained_by(lambda field, *given: field.width.add_(0.1 * torch.rand(()))),  # by the global generator
        "a resumed training arrives elsewhere",
    ),
]
ON_CUDA = ("test_field_moves_to_a_device", asked(lambda p, d: (p + cpu_offset, d)), "on CUDA raised")


@pytest.mark.parametrize(("check", "backend", "said"), [*BREAKS, pytest.param(*ON_CUDA, marks=NO_CUDA)])
def test_what_breaks_the_contract_is_told(check: str, backend: Any, said: str) -> None:
    waves = getattr(backend, "config_type", None) is WaveConfig
    more = {"config": WaveConfig(steps=6)} if waves and check not in (RGB, EXPOSURE) else {}
    contract = type("Contract", (BackendContract,), {"backend": backend, **more})()
    with pytest.raises(AssertionError) as caught:
        getattr(contract, check)()
    assert said in str(caught.value)


def test_every_check_has_a_backend_that_breaks_it() -> None:
    assert {check for check, _, _ in [*BREAKS, ON_CUDA]} == set(CHECKS)


FINE = {
    "a direction that is ignored": (asked(lambda p, d: (p, torch.zeros_like(d))), [DIRECTION]),
    "float32 alone": (asked(single), [POSITION, DIRECTION]),
    "levels": (with_levels(lambda field: (HalfSamples(field), field)), [c for c in CHECKS if "training" not in c]),
}


@pytest.mark.parametrize("name", FINE)
def test_what_the_contract_leaves_open_is_fine(name: str) -> None:
    backend, checks = FINE[name]
    contract = type("Contract", (BackendContract,), {"backend": backend, "config": WaveConfig(steps=6)})()
    for check in checks:
        getattr(contract, check)()


def test_a_backend_may_be_given_by_the_name_of_its_entry_point() -> None:
    by_name = type("Contract", (BackendContract,), {"name": "hashgrid", "config": TestHashGrid.config})
    by_name().test_build_gives_a_field()


def test_the_contract_does_not_need_pytest() -> None:
    packages = (Path(package.__file__).parent for package in (bidnerf.testing, bidnerf_core))
    files = [file for package in packages for file in package.rglob("*.py")]
    assert any(file.name == "reader_contract.py" for file in files)
    assert not [file for file in files if re.search(r"^\s*(import|from) pytest", file.read_text(), re.MULTILINE)]
