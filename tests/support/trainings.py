"""What tests of trainings share: an interruption, and the comparison of what they come to."""

from __future__ import annotations

import signal
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file
from torch import Tensor

from bidnerf_core.maps import Checkpoints, load_info
from bidnerf_core.progress import Progress
from bidnerf_core.training import TrainingStep


def stop_at(patch: pytest.MonkeyPatch, number: int) -> None:
    """Ctrl-C during that step of the next training."""
    original = Checkpoints.step

    def step(self: Checkpoints, now: TrainingStep) -> None:
        if now.step == number:
            signal.raise_signal(signal.SIGINT)
        original(self, now)

    patch.setattr(Checkpoints, "step", step)


def stopping_at(stage: str, number: int = 0) -> dict[str, Any]:
    """Return the options of a job that is cancelled in a stage, when so many of its steps are done."""
    seen = list[Progress]()
    return {
        "progress": seen.append,
        "cancel": lambda: any(now.stage == stage and now.done >= number for now in seen),
    }


def assert_same_tensors(found: Mapping[str, Tensor], expected: Mapping[str, Tensor]) -> None:
    """Assert that tensors have the same names and types, and are equal bit by bit."""
    assert found.keys() == expected.keys()
    kinds = {name: value.dtype for name, value in expected.items()}
    assert [name for name, kind in kinds.items() if found[name].dtype != kind] == []
    assert [name for name, value in expected.items() if not torch.equal(found[name], value)] == []


def assert_same_map(one: Path, other: Path) -> None:
    """Assert that weights and occupancy are equal bit by bit."""
    a, b = load_file(one / load_info(one).weights), load_file(other / load_info(other).weights)
    assert any("occupied" in name for name in a)
    assert_same_tensors(a, b)
