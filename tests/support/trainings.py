"""What tests of interrupted trainings share: the interruption, and the comparison of the maps that come of them."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from bidnerf_core.maps import Checkpoints, load_info
from bidnerf_core.training import TrainingStep


def stop_at(patch: pytest.MonkeyPatch, number: int) -> None:
    """Ctrl-C during that step of the next training."""
    original = Checkpoints.step

    def step(self: Checkpoints, now: TrainingStep) -> None:
        if now.step == number:
            signal.raise_signal(signal.SIGINT)
        original(self, now)

    patch.setattr(Checkpoints, "step", step)


def assert_same_map(one: Path, other: Path) -> None:
    """Assert that weights and occupancy are equal bit by bit."""
    a, b = load_file(one / load_info(one).weights), load_file(other / load_info(other).weights)
    assert a.keys() == b.keys()
    assert any("occupied" in name for name in a)
    assert [name for name in a if not torch.equal(a[name], b[name])] == []
