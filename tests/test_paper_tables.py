"""The script behind the paper's tables, on a closed-form scene with few rays."""

from __future__ import annotations

import importlib
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from bidnerf_core.evaluation.bench import Plan, planned

SCRIPT = Path(__file__).parents[1] / "benchmarks" / "paper_tables.py"
PLACE = "demo:blobs"
CELLS = {
    "table1": (4, 3, 8, {"bid"}),  # conditions, sizes, trials of each, methods
    "depth_weight": (2, 3, 8, {"bid"}),
    "table2": (3, 3, 16, {"bid"}),
    "inerf": (2, 1, 25, {"bid", "inerf"}),
}


@pytest.mark.parametrize("part", CELLS)
def test_the_cells_of_a_part_can_be_tried_from_the_same_starts(
    part: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(SCRIPT.parent))
    plans = importlib.import_module("paper_tables").PARTS[part](
        Plan(PLACE, PLACE, method="bid", seed=0), lambda method: {"rays": 8, "max_steps": 2}, None
    )
    conditions, sizes, each, methods = CELLS[part]
    assert len(plans) == conditions
    assert {plan.method for plan in plans} == methods
    trials = [planned(plan) for plan in plans]  # raises where a method has no such setting
    assert all(len(cell) == sizes * each for cell in trials)
    for same in zip(*trials, strict=True):
        assert len({(trial.frame, trial.size, trial.seed) for trial in same}) == 1


def test_a_part_is_recorded(tmp_path: Path) -> None:
    few = ("--trials", "1", "--rays", "8", "--steps", "1", "--workers", "1", "--part", "inerf")
    subprocess.run(
        [sys.executable, str(SCRIPT), PLACE, "--map", PLACE, "--out", str(tmp_path), *few],
        check=True, timeout=300, env=os.environ | {"OMP_NUM_THREADS": "1"},
    )  # fmt: skip
    cells = json.loads((tmp_path / "inerf_demo_blobs.json").read_text())["results"]["cells"]
    assert [cell["condition"] for cell in cells] == ["bid", "inerf"]
    assert len((tmp_path / "inerf_demo_blobs.jsonl").read_text().splitlines()) == 2
