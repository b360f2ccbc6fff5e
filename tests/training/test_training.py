"""What recipes share: batches of rays, the loop, and resuming without loss."""

from __future__ import annotations

import re
from dataclasses import replace
from itertools import pairwise
from typing import Any

import pytest
import torch
from torch import Generator, Tensor, nn

import tiny
from bidnerf.scenes import orbit
from bidnerf.testing import Recorder
from bidnerf_core.camera import Intrinsics
from bidnerf_core.carving import estimate_bounds
from bidnerf_core.fields import SceneBounds
from bidnerf_core.frames import Frame, View, all_pixels, observe
from bidnerf_core.training import (
    RayBank,
    Report,
    Silent,
    StepOutcome,
    TrainingBatch,
    TrainingState,
    TrainingStopped,
    cosine,
    fit,
)

# Inside: the share of rays with depth, compared with the rays of many batches
from bidnerf_core.training.ray_bank import MEASURED_SHARE
from bidnerf_hashgrid import HashGridField, backend
from refusals import refused
from trainings import assert_same_tensors

BOUNDS = SceneBounds((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0), 0.5, 6.0, (0.2, 0.4, 0.6))


# Resuming without loss.


@pytest.fixture(scope="module")
def scene() -> tuple[list[View], SceneBounds]:
    views = tiny.views(6)
    return views, estimate_bounds(views, tiny.BACKGROUND)


def trained(scene: tuple[list[View], SceneBounds], report: Recorder, **changes: Any) -> HashGridField:
    views, bounds = scene
    config = tiny.config(**changes)
    field = backend.build(config, bounds)
    backend.train(field, views, config, report)
    return field


@pytest.fixture(scope="module")
def uninterrupted(scene: tuple[list[View], SceneBounds]) -> TrainingState:
    report = Recorder(due=[24])
    trained(scene, report, steps=24)
    return report.saved[0]


@pytest.mark.parametrize("stops", [[1], [12], [23], [3, 4, 11]], ids=str)
def test_a_training_that_was_stopped_comes_to_the_same_end(
    stops: list[int], scene: tuple[list[View], SceneBounds], uninterrupted: TrainingState
) -> None:
    """Bit by bit: weights, occupancy, moments, generator. Pruning begins at step 4, every fourth step is coarse."""
    state = None
    for stop in stops:
        report = Recorder(stop=stop, state=state)
        with pytest.raises(TrainingStopped) as stopped:
            trained(scene, report, steps=24)
        assert stopped.value.step == stop
        (state,) = report.saved
        assert state.step == stop
    report = Recorder(due=[24], state=state)
    trained(scene, report, steps=24)
    assert [progress.step for progress in report.steps] == list(range(stops[-1] + 1, 25))
    (end,) = report.saved
    assert_same_tensors(end.field, uninterrupted.field)
    assert_same_tensors(end.optimizer, uninterrupted.optimizer)


def test_occupancy_changed_on_the_way(uninterrupted: TrainingState) -> None:
    """Else the law above would say nothing of it."""
    for name in ("occupancy", "coarse_sampler"):
        occupied = uninterrupted.field[f"{name}.occupied"]
        assert 0 < occupied.double().mean() < 1
        assert uninterrupted.field[f"{name}.peak"].unique().numel() > 5


def test_a_stop_requested_in_the_last_step_is_the_end(scene: tuple[list[View], SceneBounds]) -> None:
    report = Recorder(due=[3], stop=3)
    trained(scene, report, steps=3)
    assert [state.step for state in report.saved] == [3]


class Late(Recorder):
    """Asked to stop at the worst moment: when it was just asked whether to stop."""

    def __init__(self, asked: int) -> None:
        super().__init__()
        self.calm = iter([False] * asked)

    @property
    def stopping(self) -> bool:
        return next(self.calm, True)


@pytest.mark.parametrize("stop", [1, 2, 3, 4])
def test_a_training_stops_only_where_it_saved(stop: int) -> None:
    line, report = nn.Linear(1, 1), Late(stop)
    with pytest.raises(TrainingStopped) as stopped:
        fit(line, [{"params": line.parameters(), "lr": 0.1}], line_outcome(line), 9, report)
    assert [state.step for state in report.saved] == [stopped.value.step]


def test_the_same_seed_gives_the_same_field_and_another_another(
    scene: tuple[list[View], SceneBounds],
) -> None:
    one, again, other = (trained(scene, Recorder(), steps=3, seed=seed).state_dict() for seed in (0, 0, 1))
    assert_same_tensors(one, again)
    assert not torch.equal(one["geometry.0.weight"], other["geometry.0.weight"])


# The loop.


def line_outcome(line: nn.Linear) -> Any:
    """A step towards y = 3 x - 1."""

    def outcome(step: int, generator: Generator) -> StepOutcome:
        x = torch.rand((64, 1), generator=generator)
        loss = ((line(x) - (3 * x - 1)) ** 2).mean()
        return StepOutcome(loss, float(loss.detach()))

    return outcome


def test_the_loop_minimises() -> None:
    line, report = nn.Linear(1, 1), Recorder()
    fit(line, [{"params": line.parameters(), "lr": 0.1}], line_outcome(line), 300, report)
    torch.testing.assert_close(line.weight.detach(), torch.tensor([[3.0]]), atol=0.05, rtol=0)
    torch.testing.assert_close(line.bias.detach(), torch.tensor([-1.0]), atol=0.05, rtol=0)
    assert [progress.step for progress in report.steps] == list(range(1, 301))
    assert {progress.total for progress in report.steps} == {300}


def test_a_parameter_without_a_gradient_yet_is_resumed_too() -> None:
    """Adam keeps nothing of a parameter before its first gradient."""

    def train(report: Report) -> dict[str, Tensor]:
        torch.manual_seed(0)
        pair = nn.ModuleList([nn.Linear(1, 1), nn.Linear(1, 1)])
        first, second = map(line_outcome, pair)
        groups = [{"params": pair.parameters(), "lr": 0.1}]
        fit(pair, groups, lambda step, *more: (first if step < 6 else second)(step, *more), 12, report)
        return pair.state_dict()

    half = Recorder(stop=3)
    with pytest.raises(TrainingStopped):
        train(half)
    assert_same_tensors(train(Recorder(state=half.saved[0])), train(Silent()))


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_a_loss_that_is_not_finite_ends_the_training_before_it_spreads(bad: float) -> None:
    line, report = nn.Linear(1, 1), Recorder()
    with refused(found="training diverged") as caught:
        fit(
            line,
            [{"params": line.parameters(), "lr": 0.1}],
            lambda step, _: StepOutcome(line.weight.sum() * (bad if step == 2 else 1.0), 0.0),
            5,
            report,
        )
    assert re.search(rf"loss -?{bad} at step 3", caught.error.found)
    assert bool(line.weight.isfinite().all())
    assert [progress.step for progress in report.steps] == [1, 2]


def test_the_schedule_warms_up_and_then_falls_to_its_last_value() -> None:
    factors = [cosine(step, 1000) for step in range(1000)]
    assert factors[99] == pytest.approx(1.0)
    assert all(a < b for a, b in pairwise(factors[:100]))
    assert all(a > b for a, b in pairwise(factors[100:]))
    assert factors[-1] == pytest.approx(0.02, rel=1e-3)
    assert max(abs(a - b) for a, b in pairwise(factors)) <= 0.0101


# Rays of the training views.


def random_views(count: int, alpha: bool, depth: bool, seed: int = 0) -> list[View]:
    """Images of noise from cameras of different kinds; every pixel is unlike every other."""
    generator = torch.Generator().manual_seed(seed)
    views = []
    for number, T in enumerate(orbit(3.0, count)):
        camera = Intrinsics(9.0, 11.0, 4.5, 3.0, 8, 6) if number % 2 else Intrinsics(7.0, 7.0, 2.0, 2.5, 4, 5)
        size = (camera.height, camera.width)
        cover = torch.rand(size, generator=generator).sub(0.3).div(0.4).clamp(0, 1) if alpha else None
        metres = torch.rand(size, generator=generator) * 3 if depth else None
        if metres is not None:
            metres[0] = 0
        views.append(View(Frame(str(number), torch.rand((*size, 3), generator=generator), camera, metres, cover), T))
    return views


def drawn(views: list[View], count: int = 400) -> tuple[TrainingBatch, list[Tensor], Tensor]:
    """A batch, and for each of its rays what ``observe`` says of its pixel: origin, direction, colour, distance; alpha."""
    bank = RayBank(views, BOUNDS)
    batch = bank.draw(count, torch.Generator().manual_seed(1))
    index = torch.randint(bank.count, (count,), generator=torch.Generator().manual_seed(1))
    seen = [observe(view, all_pixels(view.frame)) for view in views]
    every = [torch.cat([getattr(part, name) for part in seen]) for name in ("origins", "directions", "rgb", "distance")]
    assert len(every[0]) == bank.count
    covers = [torch.ones(v.frame.rgb.shape[:2]) if v.frame.alpha is None else v.frame.alpha for v in views]
    return batch, [part[index] for part in every], torch.cat([c.reshape(-1) for c in covers])[index]


@pytest.mark.parametrize(
    "kinds",  # whether some images have alpha, and depth
    [[(True, True)], [(True, False)], [(False, True)], [(False, False)], [(True, True), (False, False)]],
    ids=str,
)
@pytest.mark.parametrize("moving", [True, False])
def test_rays_are_those_of_the_pixels(kinds: list[tuple[bool, bool]], moving: bool) -> None:
    """Also of landscape and portrait images whose rows are exposed one after another."""
    views = [view for seed, kind in enumerate(kinds) for view in random_views(4, *kind, seed)]
    if moving:
        motion = torch.tensor([0.2, -0.1, 0.3, 0.1, 0.3, -0.2], dtype=torch.float64)
        views[1:] = [replace(view, motion=motion) for view in views[1:]]
    batch, (origins, directions, rgb, distance), cover = drawn(views)
    expected = BOUNDS.rays(origins, directions)
    for name in ("origins", "directions", "near", "far"):
        torch.testing.assert_close(getattr(batch.rays, name), getattr(expected, name), atol=2e-6, rtol=2e-6)
    torch.testing.assert_close(batch.observed.distance, distance, atol=1e-6, rtol=1e-6)
    assert bool((batch.observed.distance > 0).any()) == any(depth for _, depth in kinds)
    torch.testing.assert_close(torch.linalg.vector_norm(batch.rays.directions, dim=-1), torch.ones(400))
    shown = (1 - cover)[:, None] * (batch.background - torch.tensor(BOUNDS.background))
    torch.testing.assert_close(batch.observed.rgb, rgb + shown)
    assert torch.equal(batch.observed.rgb[cover == 1], rgb[cover == 1])
    if not any(alpha for alpha, _ in kinds):
        assert torch.equal(batch.background, torch.tensor(BOUNDS.background).expand(400, 3))


def test_a_background_that_shows_through_is_another_for_each_ray() -> None:
    batch, (_, _, rgb, _), cover = drawn(random_views(5, alpha=True, depth=False))
    assert bool((cover == 0).any())
    assert bool((cover == 1).any())
    assert len(batch.background.unique(dim=0)) == len(batch.background)
    assert bool(((batch.background >= 0) & (batch.background <= 1)).all())
    changed = (batch.observed.rgb != rgb).any(-1)
    assert torch.equal(changed, cover < 1)


@pytest.mark.parametrize("share", [0.0, 0.6])
def test_every_visible_pixel_is_as_likely_as_any_other(share: float, generator: torch.Generator) -> None:
    views = random_views(3, False, False)
    hidden = [torch.rand(view.frame.rgb.shape[:2], generator=generator) < share for view in views]
    views = [replace(view, frame=view.frame.with_hidden(part)) for view, part in zip(views, hidden, strict=True)]
    batch = RayBank(views, BOUNDS).draw(20000, torch.Generator().manual_seed(0))
    colours, counts = batch.observed.rgb.unique(dim=0, return_counts=True)
    visible = torch.cat([view.frame.rgb[~part] for view, part in zip(views, hidden, strict=True)])
    assert torch.equal(colours, visible.unique(dim=0))
    expected = 20000 / len(visible)
    assert bool(((counts - expected).abs() < 6 * expected**0.5).all())


def test_where_few_pixels_have_depth_a_share_of_the_rays_goes_through_them() -> None:
    """Drawn uniformly, 3 of 164 pixels would be met by 2 % of the rays; all of the three are, and no others among those."""
    views = random_views(5, True, True)
    few = [replace(v, frame=replace(v.frame, depth=torch.zeros_like(v.frame.depth))) for v in views]  # type: ignore[arg-type]
    for number in (0, 1, 4):
        few[number].frame.depth[3, 2] = 1.0 + number  # type: ignore[index]
    batch = RayBank(few, BOUNDS).draw(400, torch.Generator().manual_seed(0))
    measured = batch.observed.distance > 0
    assert float(measured.float().mean()) == pytest.approx(MEASURED_SHARE, abs=0.05)
    assert len(batch.observed.distance[measured].unique()) == 3
    for view in (few[0], few[1], few[4]):
        seen = observe(view, torch.tensor([[2, 3]]))
        here = (batch.observed.distance - seen.distance).abs() < 1e-5
        assert int(here.sum()) > 10
        torch.testing.assert_close(batch.rays.directions[here], seen.directions.expand(int(here.sum()), 3))
    assert len(batch.observed.distance[~measured]) > 250
