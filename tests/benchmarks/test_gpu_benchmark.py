"""The benchmark for GPUs where there is none: it says so, and its steps are those of ``bid``."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest
import torch

Script = Callable[[str], ModuleType]
PLACE = "demo:blobs"


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU here")
def test_without_a_gpu_it_says_so_and_writes_nothing(
    tmp_path: Path, script: Script, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["gpu.py", PLACE, "--map", PLACE, "--out", str(tmp_path)])
    script("gpu").main()
    assert capsys.readouterr().out == "no GPU here: nothing was measured, and no record was written\n"
    assert not list(tmp_path.iterdir())


def test_its_steps_leave_the_pose_where_it_is(script: Script) -> None:
    gpu = script("gpu")
    steps = gpu.made_steps(PLACE, PLACE, 0, torch.device("cpu"), rays=32)
    start = steps.T
    steps()
    _, losses, finite = steps.block()
    assert bool(finite[0])
    assert float(losses[0]) > 0
    torch.testing.assert_close(steps.T.matrix(), start.matrix(), rtol=0, atol=1e-7)


def test_a_row_that_fails_says_why_and_does_not_stop_the_others(script: Script) -> None:
    gpu = script("gpu")

    def broken() -> None:
        raise RuntimeError("out of memory\nand a second line")

    assert gpu.attempt("a row", broken) == {"failed": "RuntimeError: out of memory"}
    assert gpu.attempt("a row", lambda: {"ms": 1.0}) == {"ms": 1.0}
