"""The script behind the paper's tables, on a closed-form scene with few rays."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest

from bidnerf_core.evaluation import Plan, Trial, planned
from bidnerf_core.scenes import closed_form_data

Script = Callable[[str], ModuleType]
SCRIPT = Path(__file__).parents[2] / "benchmarks" / "paper_tables.py"
PLACE = "demo:blobs"
CELLS = {
    "table1": (4, 3, 8, {"bid"}),  # conditions, sizes, trials of each, methods
    "depth_weight": (2, 3, 8, {"bid"}),
    "table2": (3, 3, 16, {"bid"}),
    "inerf": (2, 1, 25, {"bid", "inerf"}),
}


def trials_of(plan: Plan) -> list[Trial]:
    return planned(plan, PLACE, PLACE, closed_form_data(PLACE))


@pytest.mark.parametrize("part", CELLS)
def test_the_cells_of_a_part_can_be_tried_from_the_same_starts(part: str, script: Script) -> None:
    plans = script("paper_tables").PARTS[part](
        Plan(method="bid", seed=0), lambda method: {"rays": 8, "max_steps": 2}, None, (PLACE, PLACE)
    )
    conditions, sizes, each, methods = CELLS[part]
    assert len(plans) == conditions
    assert {plan.method for plan in plans} == methods
    trials = [trials_of(plan) for plan in plans]  # raises where a method has no such setting
    assert all(len(cell) == sizes * each for cell in trials)
    for same in zip(*trials, strict=True):
        assert len({(trial.frame, trial.size, trial.seed) for trial in same}) == 1


@pytest.mark.slow
def test_a_part_is_recorded(tmp_path: Path) -> None:
    few = ("--trials", "1", "--rays", "8", "--steps", "1", "--workers", "1", "--part", "inerf")
    subprocess.run(
        [sys.executable, str(SCRIPT), PLACE, "--map", PLACE, "--out", str(tmp_path), *few],
        check=True, timeout=300, env=os.environ | {"OMP_NUM_THREADS": "1"},
    )  # fmt: skip
    cells = json.loads((tmp_path / "inerf_demo_blobs.json").read_text())["results"]["cells"]
    assert [cell["condition"] for cell in cells] == ["bid", "inerf"]
    assert len((tmp_path / "inerf_demo_blobs.jsonl").read_text().splitlines()) == 2


def test_presets_become_settings_of_each_method(script: Script) -> None:
    settings_of_preset = script("paper_tables").preset_settings
    bid = settings_of_preset("paper", {"rays": 7}, "bid")
    assert bid == {
        "rays": 7, "pivot": "camera", "max_steps": 1000, "learning_rate": 0.02, "decay": 0.8, "decay_steps": 100,
        "depth_scale": 0.1, "candidates": 1, "box_weight": 0.0,
    }  # fmt: skip
    assert settings_of_preset("paper-scene", {}, "inerf") == {"max_steps": 1000}
