"""What only a GPU can show: skipped where there is none."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

import baked
import module_fields
import tiny
from bidnerf import Localization, Localizer
from bidnerf.cli import main
from bidnerf.testing import SCENE_BOUNDS as BOUNDS
from bidnerf.testing import Recorder, rgbd_views, textured_map, unseen
from bidnerf_core import devices
from bidnerf_core.backend import load_backend, quick_config
from bidnerf_core.devices import capture_graph, constant
from bidnerf_core.fields import FieldValues, SceneBounds, device_of, levels, render_image
from bidnerf_core.geometry import perturb
from bidnerf_core.localization import settings_of
from bidnerf_core.maps import load_map
from bidnerf_core.training import TrainingStopped
from optional import require
from problems import FieldMap

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no GPU here")

BUNDLED = ("hashgrid", "vanilla", "adanerf")


class Synchronizing(torch.nn.Module):
    """A field that reads a number from the device in each query, as no step may."""

    def __init__(self, field: torch.nn.Module) -> None:
        super().__init__()
        self.field: Any = field

    @property
    def sampler(self) -> Any:
        return self.field.sampler

    def query(self, positions: Tensor, directions: Tensor) -> FieldValues:
        assert float(positions.detach().abs().amax()) < 1e6
        return self.field.query(positions, directions)  # type: ignore[no-any-return]


def descent(field: Any, bounds: SceneBounds, method: str = "bid", steps: int = 50) -> Tensor:
    """Return the poses (s 4 4) of a short descent on the GPU."""
    view = rgbd_views(coverage=False)[0]
    config = settings_of(method, {"max_steps": steps, "rays": 256})
    localizer = Localizer(FieldMap(field, bounds, None), method, config, device="cuda")
    return localizer(view.frame, perturb(view.T_ref_camera, 0.1, 3.0, seed=0)).poses.matrix()


def noting(captured: list[bool]) -> Any:
    """Return a ``capture_graph`` that notes whether each step could be captured."""

    def noted(step: Any, *rest: Any, **more: Any) -> Any:
        replay = capture_graph(step, *rest, **more)
        captured.append(replay is not step)
        return replay

    return noted


@pytest.fixture
def captures(monkeypatch: pytest.MonkeyPatch) -> list[bool]:
    """Whether each step that was to be captured could be."""
    found: list[bool] = []
    monkeypatch.setattr("bidnerf_bid.adam.capture_graph", noting(found))
    return found


@pytest.mark.parametrize("method", ["bid", "inerf"])
@pytest.mark.parametrize("name", BUNDLED)
def test_replayed_steps_are_those_that_are_launched(
    name: str, method: str, captures: list[bool], monkeypatch: pytest.MonkeyPatch
) -> None:
    backend = load_backend(name)
    field = backend.build(backend.config_type(), BOUNDS)
    replayed = descent(field, BOUNDS, method)
    assert captures == [True]
    monkeypatch.setattr("bidnerf_bid.adam.capture_graph", lambda step, *_: step)
    launched = descent(field, BOUNDS, method)
    assert len(replayed) == len(launched) == 51
    torch.testing.assert_close(replayed, launched, rtol=0, atol=1e-4)


def test_a_captured_step_keeps_the_constants_that_it_reads(captures: list[bool]) -> None:
    field, device = module_fields.field().to("cuda"), torch.device("cuda")
    expected, start = descent(field, baked.BOUNDS), torch.zeros(3, device=device)
    step_result = torch.zeros(3, device=device)

    def step() -> None:
        step_result.copy_(start + constant((1.25, -2.5, 3.75), start))

    step()
    replay = capture_graph(step, device, torch.Generator(device))
    devices.forget()
    _ = [torch.full((3,), -1.0, device=device) for _ in range(1000)]  # would take its place
    step_result.zero_()
    replay()
    assert step_result.tolist() == [1.25, -2.5, 3.75]
    torch.testing.assert_close(descent(field, baked.BOUNDS), expected, rtol=0, atol=1e-4)


def test_steps_of_a_field_that_reads_from_the_device_are_launched(captures: list[bool]) -> None:
    field = module_fields.field()
    plain = descent(field, baked.BOUNDS)
    with pytest.warns(UserWarning, match="cannot be captured"):
        reading = descent(Synchronizing(field), baked.BOUNDS)
    again = descent(field, baked.BOUNDS)
    assert captures == [True, False, True]
    assert torch.cuda.current_stream() == torch.cuda.default_stream()
    for found in (reading, again):
        torch.testing.assert_close(found, plain, rtol=0, atol=1e-4)


def test_queries_have_the_answers_of_the_cpu_and_replay_graphs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Several at once as well as one by one."""
    here, replayed = textured_map(surface=True), list[bool]()
    scene = replace(here, field=module_fields.AsModule(here.field))
    frames = [unseen().frame, unseen().frame.replace(depth=None)]
    monkeypatch.setattr("bidnerf_core.devices.capture_graph", noting(replayed))
    expected, there = [Localizer(scene)(frame) for frame in frames], Localizer(scene, device="cuda")
    for _ in range(3):
        found = [there(frame) for frame in frames]
    assert replayed
    for number, answer in enumerate(there.many(4 * frames, workers=3)):
        assert isinstance(answer, Localization)
        for other in (found, expected):
            same = other[number % 2]
            assert answer.outcome is same.outcome
            torch.testing.assert_close(answer.T_world_camera.matrix(), same.T_world_camera.matrix(), rtol=0, atol=1e-3)
    assert all(replayed)


@pytest.mark.parametrize("name", BUNDLED)
def test_training_on_a_gpu_replays_its_steps_and_learns_what_it_learns_on_a_cpu(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    backend, losses, replayed = load_backend(name), [], list[bool]()
    config = replace(quick_config(backend), steps=60)

    def launched(step: Any, *_: Any) -> Any:
        return step

    for device, capture in (("cpu", launched), ("cuda", launched), ("cuda", noting(replayed))):
        monkeypatch.setattr("bidnerf_core.training.loop.capture_graph", capture)
        torch.manual_seed(0)
        field: Any = backend.build(config, BOUNDS)
        report = Recorder()
        backend.train(field.to(device), rgbd_views(), config, report)
        losses.append(torch.tensor([step.loss for step in report.steps]))
    assert replayed
    assert all(replayed)
    on_cpu, one_by_one, as_graphs = losses
    torch.testing.assert_close(as_graphs[:30], one_by_one[:30], rtol=1e-2, atol=1e-5)
    assert float(as_graphs[-5:].mean()) < 1.1 * float(on_cpu[-5:].mean())


def test_a_training_goes_on_on_another_device() -> None:
    """Its random numbers are others, as those of a CPU are not those of a GPU."""
    backend = load_backend("hashgrid")
    config, views = replace(quick_config(backend), steps=48), rgbd_views()
    half, losses = Recorder(stop=24), []
    with pytest.raises(TrainingStopped):
        backend.train(backend.build(config, BOUNDS), views, config, half)  # on the CPU
    for device in ("cpu", "cuda"):
        field: Any = backend.build(config, BOUNDS)
        rest = Recorder(state=half.saved[0])
        backend.train(field.to(device), views, config, rest)
        assert len(rest.steps) == 24
        losses.append(sum(step.loss for step in rest.steps) / 24)
    assert losses[1] == pytest.approx(losses[0], rel=0.2)


def test_a_map_that_was_made_on_a_gpu_serves_on_a_cpu(tmp_path: Path) -> None:
    data, map = tiny.write_dataset(tmp_path / "data"), tmp_path / "map"
    assert main(["train", str(data), "--out", str(map), "--device", "cuda", *tiny.options()]) == 0
    assert main(["bake", str(map), "--device", "cuda", "--opacity", "0.01", "--agreement", "0"]) == 0
    made = load_map(map)
    assert device_of(made.field).type == require(made.surface).surfels.positions.device.type == "cpu"


def test_levels_lie_where_their_field_does() -> None:
    backend = load_backend("hashgrid")
    field: Any = backend.build(backend.config_type(), BOUNDS)
    view = rgbd_views()[0]
    there = field.to("cuda")
    for level in levels(there):
        assert device_of(level).type == "cuda"
        assert render_image(level, view.frame.intrinsics, view.T_ref_camera, BOUNDS).rgb.device.type == "cpu"
