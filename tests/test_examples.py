"""Every example runs as its first lines say."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path

import pytest

from bidnerf_core.fields import residuals

EXAMPLES = sorted((Path(__file__).parents[1] / "examples").glob("*.py"))


@pytest.mark.slow
@pytest.mark.parametrize("example", EXAMPLES, ids=[path.stem for path in EXAMPLES])
def test_example_runs(
    example: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """In this process: each process of its own would import PyTorch and its compiler anew."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [str(example), "--steps", "12", "--descent", "3"])
    monkeypatch.setattr(sys, "path", [str(example.parent), *sys.path])
    before = dict(residuals.DEPTH_RESIDUALS)
    try:
        runpy.run_path(str(example), run_name="__main__")
    finally:
        residuals.DEPTH_RESIDUALS.clear()
        residuals.DEPTH_RESIDUALS.update(before)
    printed = capsys.readouterr().out
    assert "off by" in printed or "ms a step" in printed
