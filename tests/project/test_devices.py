"""Maps move to another device as a whole: every tensor does, and methods find the same poses there."""

from __future__ import annotations

import functools
import gc
import weakref
from collections.abc import Iterator
from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import Any

import pytest
import torch
from torch import Tensor, nn

import baked
import module_fields
import tiny
from balls import HomogeneousBall
from bidnerf import Localizer, Map
from bidnerf.testing import textured_map
from bidnerf_core.backend import load_backend
from bidnerf_core.devices import Resident, may_wait, move_to, run_on
from bidnerf_core.io import to_plain
from bidnerf_core.localization import AutoConfig
from bidnerf_core.mapping import LandmarkMap
from bidnerf_core.maps import MapInfo
from optional import require
from problems import FieldMap
from refusals import refused
from simulated_device import DEVICE, Elsewhere

CPU = torch.device("cpu")
QUICK = AutoConfig(points=400, hypotheses=48, rounds=1, refine_steps=2, refine_rays=64, fused_rays=64)


def tensors_in(value: Any, path: str = "map") -> Iterator[tuple[str, Tensor]]:
    """Yield every tensor that can be reached from ``value`` by any attribute or item, with the way to it."""
    if isinstance(value, Tensor):
        yield path, value
    elif isinstance(value, dict):
        for key, part in value.items():
            yield from tensors_in(part, f"{path}[{key!r}]")
    elif isinstance(value, list | tuple | set | frozenset):
        for number, part in enumerate(value):
            yield from tensors_in(part, f"{path}[{number}]")
    elif isinstance(value, nn.Module) or is_dataclass(value) or type(value).__module__.startswith("bidnerf"):
        parts = dict(getattr(value, "__dict__", {}))
        if is_dataclass(value):
            parts |= {part.name: getattr(value, part.name) for part in fields(value)}
        for name, part in parts.items():
            yield from tensors_in(part, f"{path}.{name}")


def elsewhere_of(value: Any, device: torch.device) -> list[str]:
    """Return the ways to the tensors that are not on ``device``."""
    found = [(path, part.device) for path, part in tensors_in(value)]
    assert found
    return [path for path, where in found if where != device]


@functools.cache
def landmarks() -> LandmarkMap:
    return require(textured_map().landmarks)


def whole_map(backend: str) -> Map:
    """Return an untrained map of a backend with all that may be baked beside it."""
    made = load_backend(backend)
    config = tiny.config() if backend == "hashgrid" else made.config_type()
    info = MapInfo(backend, to_plain(config), baked.BOUNDS, 0, True)
    return Map(info, made.build(config, baked.BOUNDS), baked.toy(), landmarks())


@pytest.mark.parametrize("backend", ["hashgrid", "vanilla", "adanerf"])
def test_every_tensor_of_a_map_moves_and_keeps_its_value(backend: str) -> None:
    stored = whole_map(backend)
    with Elsewhere():
        there = stored.to(DEVICE)
        assert elsewhere_of(there, DEVICE) == []
        assert elsewhere_of(Localizer(there, "bid").scene, DEVICE) == []  # what is cached lies there too
        moved_parts = {path: part.cpu() for path, part in tensors_in(there)}
    assert elsewhere_of(stored, CPU) == []
    here = dict(tensors_in(stored))
    assert len(moved_parts) >= len(here) > 20
    assert all(torch.equal(moved_parts[path], part) for path, part in here.items() if path in moved_parts)


def test_what_lies_there_already_is_not_copied() -> None:
    stored = whole_map("hashgrid")
    assert stored.to("cpu") is stored
    assert require(stored.surface).to(CPU) is stored.surface
    assert landmarks().to("cpu") is landmarks()
    assert Localizer(stored, "bid", device="cpu", warm_up=False).scene is stored


def test_parts_may_be_missing_and_a_field_that_cannot_move_is_refused() -> None:
    bare = FieldMap(module_fields.field(), baked.BOUNDS)
    with Elsewhere():
        assert elsewhere_of(Localizer(bare, "bid", device=DEVICE, warm_up=False).scene, DEVICE) == []
    ball = FieldMap(HomogeneousBall(0.5, 10.0), baked.BOUNDS)
    with refused(where="device cpu", found="HomogeneousBall", expected="an nn.Module"):
        Localizer(ball, "bid", device="cpu")


@dataclass(frozen=True, eq=False)
class Nested:
    given: list[Tensor]
    named: dict[str, tuple[Tensor, int]]
    module: nn.Module
    derived: Tensor = field(init=False)
    nothing: None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "derived", 2 * self.given[0])


NESTED = Nested([torch.ones(2)], {"a": (torch.zeros(3), 5)}, nn.Linear(2, 2))


def test_tensors_move_wherever_they_are_held() -> None:
    with Elsewhere():
        there = move_to(NESTED, DEVICE)
        assert elsewhere_of(there, DEVICE) == []
        assert sum(1 for _ in tensors_in(there)) == 5
    assert elsewhere_of(NESTED, CPU) == []
    assert there.named["a"][1] == 5


@dataclass(frozen=True, eq=False)
class Table(Resident):
    values: Tensor


def looked_up(given: Nested, table: Table, place: Tensor, number: float) -> tuple[Tensor, Nested, bool]:
    numbers = given.named["a"][0][place] + table.values.sum() * number
    return numbers, replace(given, given=[numbers > 1, place]), True


def test_functions_run_elsewhere_with_one_copy_there_and_one_back() -> None:
    """Repeated calls reuse the tensors of the first, whose results are not overwritten."""
    table = Table(torch.ones(2))
    calls = [(NESTED, table, torch.tensor([k, 1, 0]).int(), 0.5) for k in range(3)]
    expected = [looked_up(*call) for call in calls]
    with Elsewhere() as mode:
        there = move_to(table, DEVICE)
        mode.waits.clear()
        found = [run_on(DEVICE, looked_up, call[0], there, *call[2:]) for call in calls]
        assert mode.waits == {"copy_": 3, "_to_copy": 3}
    for ours, theirs in zip(found, expected, strict=True):
        assert elsewhere_of(ours, CPU) == []
        assert torch.equal(ours[0], theirs[0])
        assert all(map(torch.equal, ours[1].given, theirs[1].given))
        assert (ours[1].module, ours[2]) == (NESTED.module, True)


def test_what_is_remembered_of_a_call_keeps_no_field_or_surface_alive() -> None:
    with Elsewhere():
        given, table = replace(NESTED, module=nn.Linear(2, 2)), move_to(Table(torch.ones(2)), DEVICE)
        parts = [weakref.ref(given.module), weakref.ref(table)]
        run_on(DEVICE, looked_up, given, table, torch.tensor([1]).int(), 0.5)
        del given, table
        gc.collect()
        assert [part() for part in parts] == [None, None]


def test_neither_a_capture_nor_a_call_may_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is computed often depends on it: a capture must see what is then replayed."""
    waits = []

    def noted(step: Any, *rest: Any, **more: Any) -> Any:
        step()
        return step

    def doubled(values: Tensor) -> Tensor:
        waits.append(may_wait(values.device))
        return 2 * values

    monkeypatch.setattr("bidnerf_core.devices.capture_graph", noted)
    with Elsewhere():
        assert [float(run_on(DEVICE, doubled, torch.tensor(k))) for k in (1.0, 2.0, 3.0)] == [2, 4, 6]
    assert waits == [False] * 5  # one of them before the capture, and one in it


@pytest.mark.parametrize("device", ["mars", "cuda:99", "cpu:5", "meta", ""])
def test_a_device_that_does_not_work_is_named(device: str) -> None:
    stored = whole_map("vanilla")
    for move in (stored.to, require(stored.surface).to, landmarks().to):
        with refused(found=f"device {device!r} does not work here", expected="cpu"):
            move(device)
