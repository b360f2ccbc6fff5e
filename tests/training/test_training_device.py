"""Training on a device: steps neither wait nor copy, and learn what they learn on a CPU."""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import pytest
import torch

import tiny
from bidnerf.testing import Recorder
from bidnerf_core.fields import RaySamples, query_samples
from bidnerf_core.frames import View
from bidnerf_core.training import RayBank, TrainingStopped, ray_bank

# Inside: steps without room for their samples
from bidnerf_hashgrid import recipe
from simulated_device import DEVICE, Elsewhere
from small_backends import BACKENDS, BOUNDS, train_field
from test_supervision import seen

VIEWS = tiny.views(6)
# On a device, the sampler that concentrates samples draws random numbers for all rays.
CHANGES: dict[str, dict[str, Any]] = {"hashgrid": {"samples_per_ray": 0, "rays_at_most": 32, "prune_from": 24}}


@contextmanager
def elsewhere(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[int]]:
    """Simulate a device on which a step that would be replayed as a graph must not wait; yields a list with an item for each."""
    replays: list[int] = []
    with Elsewhere() as mode:

        def captured(step: Callable[[], None], device: torch.device, generator: Any, memory: Any) -> Callable[[], None]:
            assert device == generator.device == DEVICE

            def replay() -> None:
                replays.append(1)
                with mode.strict():
                    step()

            return replay

        monkeypatch.setattr("bidnerf_core.training.loop.capture_graph", captured)
        yield replays


def trained(
    name: str, report: Recorder, device: torch.device | str = "cpu", views: list[View] = VIEWS, **changes: Any
) -> None:
    usual = {"rays_at_most": 64, "carve": True} | CHANGES.get(name, {})
    train_field(name, views, report, device, **(usual | changes))


@functools.cache
def on_device(name: str) -> tuple[Recorder, int]:
    """Return what a whole training on the device reported, and how many of its steps would be replayed."""
    report = Recorder()
    with pytest.MonkeyPatch.context() as patch, elsewhere(patch) as replays:
        trained(name, report, DEVICE)
    return report, len(replays)


@pytest.mark.parametrize("name", BACKENDS)
def test_steps_on_a_device_do_not_wait_and_are_those_of_the_cpu(name: str) -> None:
    here, (there, replays) = Recorder(), on_device(name)
    trained(name, here)
    assert replays > 20
    assert [step.step for step in there.steps] == list(range(1, 41))
    for part in ("loss", "psnr", "samples_per_ray"):
        found, expected = (torch.tensor([getattr(s, part) for s in r.steps]) for r in (there, here))
        torch.testing.assert_close(found, expected, rtol=2e-3, atol=1e-5)


def test_masks_landmarks_motion_and_exposure_are_drawn_without_waiting(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    views = []
    for number, view in enumerate(VIEWS):
        hidden = torch.zeros_like(view.frame.rgb[..., 0], dtype=torch.bool)
        hidden[number:, ::3] = True
        changed = replace(seen(view, 7), motion=torch.full((6,), 0.01, dtype=torch.float64))
        views.append(replace(changed, frame=replace(changed.frame, alpha=None, hidden=hidden)))
    here, there = Recorder(), Recorder()
    trained("vanilla", here, "cpu", views, distortion_weight=0.1, steps=20)
    with elsewhere(monkeypatch) as replays:
        trained("vanilla", there, DEVICE, views, distortion_weight=0.1, steps=20)
    assert len(replays) == 18
    found, expected = (torch.tensor([step.loss for step in report.steps]) for report in (there, here))
    torch.testing.assert_close(found, expected, rtol=2e-3, atol=1e-5)


def test_images_that_are_too_large_for_a_device_stay_on_the_host(monkeypatch: pytest.MonkeyPatch) -> None:
    here, there = Recorder(), Recorder()
    trained("vanilla", here, steps=20)
    monkeypatch.setattr(ray_bank, "_home_of", lambda *_: torch.device("cpu"))
    with elsewhere(monkeypatch) as replays:
        trained("vanilla", there, DEVICE, steps=20)
    assert not replays
    found, expected = ([step.loss for step in report.steps] for report in (there, here))
    assert found == pytest.approx(expected, rel=1e-3)


@pytest.mark.filterwarnings("ignore:.*to a meta parameter")
def test_a_training_on_a_device_resumes_there_and_elsewhere(monkeypatch: pytest.MonkeyPatch) -> None:
    halves = []
    for device in ("cpu", DEVICE):
        half = Recorder(stop=20)
        with elsewhere(monkeypatch), pytest.raises(TrainingStopped):
            trained("hashgrid", half, device)
        halves.append(half.saved[0])
    assert [half.step for half in halves] == [20, 32]  # where the host next reads from the device
    whole, _ = on_device("hashgrid")
    with elsewhere(monkeypatch):
        for half in halves:
            rest = Recorder(state=half)
            trained("hashgrid", rest, DEVICE)
            assert [step.step for step in rest.steps] == list(range(half.step + 1, 41))
            found, expected = ([s.loss for s in r.steps][-8:] for r in (rest, whole))
            assert found == pytest.approx(expected, rel=1e-4)


def test_samples_that_do_not_fit_are_reported(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(recipe, "SPARE", 0.01)
    with elsewhere(monkeypatch), caplog.at_level(logging.INFO, "bidnerf"):
        trained("hashgrid", Recorder(), DEVICE, steps=8)
    assert "samples did not fit" in caplog.text


@pytest.mark.parametrize("room", [1, 40, 1000])
def test_packed_samples_have_the_values_of_the_others(room: int, generator: torch.Generator) -> None:
    field = BACKENDS["hashgrid"][0].build(tiny.config(), BOUNDS)
    rays = RayBank(VIEWS, BOUNDS).draw(12, generator).rays
    borders = torch.linspace(2, 4, 9).expand(12, -1)
    samples = RaySamples(borders[:, :-1], borders[:, 1:], torch.rand((12, 8), generator=generator) < 0.5)
    expected, (values, kept) = query_samples(field, rays, samples), recipe.query_packed(field, rays, samples, room)
    assert int(kept.valid.sum()) == min(room, int(samples.valid.sum()))
    assert torch.equal(
        kept.valid.reshape(-1), samples.valid.reshape(-1) & (samples.valid.reshape(-1).cumsum(0) <= room)
    )
    for found, part in ((values.density, expected.density), (values.rgb, expected.rgb)):
        torch.testing.assert_close(found[kept.valid], part[kept.valid])
        assert not bool(found[~kept.valid].any())
    weights = torch.rand(12, 8, generator=generator) * kept.valid
    slopes = [torch.autograd.grad((v.density * weights).sum(), field.encoding.tables[0])[0] for v in (values, expected)]
    torch.testing.assert_close(*slopes)
