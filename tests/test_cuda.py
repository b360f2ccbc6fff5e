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
from bidnerf_core import Localizer
from bidnerf_core.backend import quick_config
from bidnerf_core.cli import main
from bidnerf_core.evaluation.protocols import perturb
from bidnerf_core.field import FieldValues, SceneBounds, device_of, levels
from bidnerf_core.localization import settings_of
from bidnerf_core.localization.solvers import adam
from bidnerf_core.localization.solvers.cuda_graph import recorded
from bidnerf_core.registry import load_backend
from bidnerf_core.rendering import render_image
from bidnerf_core.storage import load_map
from bidnerf_core.testing.scene import BOUNDS, rgbd_views
from bidnerf_core.training import Progress, Silent
from problems import FieldMap

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no GPU here")

BUNDLED = ("hashgrid", "vanilla", "adanerf")


class Reading(torch.nn.Module):
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


def descent(field: Any, bounds: SceneBounds, device: str, steps: int = 50) -> Tensor:
    """Return the poses (s 4 4) of a short descent of ``bid``."""
    view = rgbd_views(coverage=False)[0]
    config = settings_of("bid", {"max_steps": steps, "rays": 256})
    found = Localizer(FieldMap(field, bounds, None), "bid", config, device=device)(
        view.frame, perturb(view.T_ref_camera, 0.1, 3.0, seed=0)
    )
    assert found.poses is not None
    return found.poses.matrix()


@pytest.mark.parametrize("name", BUNDLED)
def test_replayed_steps_are_those_that_are_launched(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    backend = load_backend(name)
    field = backend.build(backend.config_type(), BOUNDS)
    graphs: list[bool] = []

    def noted(step: Any, *rest: Any) -> Any:
        found = recorded(step, *rest)
        graphs.append(found is not step)
        return found

    monkeypatch.setattr(adam, "recorded", noted)
    replayed = descent(field, BOUNDS, "cuda")
    assert graphs == [True]
    monkeypatch.setattr(adam, "recorded", lambda step, *_: step)
    launched = descent(field, BOUNDS, "cuda")
    assert len(replayed) == len(launched) == 51
    torch.testing.assert_close(replayed, launched, rtol=0, atol=1e-4)


def test_steps_of_a_field_that_reads_from_the_device_are_launched(monkeypatch: pytest.MonkeyPatch) -> None:
    field = module_fields.field()
    plain = descent(field, baked.BOUNDS, "cuda")
    reading = descent(Reading(field), baked.BOUNDS, "cuda")
    torch.testing.assert_close(reading, plain, rtol=0, atol=1e-4)


class Noted(Silent):
    """A report that keeps the losses."""

    def __init__(self) -> None:
        self.losses: list[float] = []

    def step(self, progress: Progress) -> None:
        self.losses.append(progress.loss)


@pytest.mark.parametrize("name", BUNDLED)
def test_training_there_learns_what_it_learns_here(name: str) -> None:
    backend, losses = load_backend(name), []
    config = replace(quick_config(backend), steps=60)
    for device in ("cpu", "cuda"):
        field: Any = backend.build(config, BOUNDS)
        report = Noted()
        backend.train(field.to(device), rgbd_views(), config, report)
        losses.append(torch.tensor(report.losses))
    here, there = losses
    torch.testing.assert_close(there[:5], here[:5], rtol=1e-3, atol=1e-5)
    assert float(there[-5:].mean()) < 1.1 * float(here[-5:].mean())


def test_a_map_that_was_made_there_serves_here(tmp_path: Path) -> None:
    data, map = tiny.write_dataset(tmp_path / "data"), tmp_path / "map"
    assert main(["train", str(data), "--out", str(map), "--device", "cuda", *tiny.options()]) == 0
    assert main(["bake", str(map), "--device", "cuda", "--opacity", "0.01", "--agreement", "0"]) == 0
    made = load_map(map)
    assert made.surface is not None
    assert device_of(made.field).type == made.surface.surfels.positions.device.type == "cpu"


def test_levels_lie_where_their_field_does() -> None:
    backend = load_backend("hashgrid")
    field: Any = backend.build(backend.config_type(), BOUNDS)
    view = rgbd_views()[0]
    there = field.to("cuda")
    for level in levels(there):
        assert device_of(level).type == "cuda"
        assert render_image(level, view.frame.intrinsics, view.T_ref_camera, BOUNDS).rgb.device.type == "cpu"
