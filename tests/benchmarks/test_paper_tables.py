"""The script behind the paper's tables, on a closed-form scene with few rays."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import pytest

from bidnerf.evaluation import Group, Plan, Trial, grouped, planned
from bidnerf.scenes import closed_form_data
from trial_results import trial_result

Script = Callable[[str], ModuleType]
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


@pytest.mark.usefixtures("small_images")
def test_a_part_is_recorded(tmp_path: Path, script: Script, monkeypatch: pytest.MonkeyPatch) -> None:
    few = ["--trials", "1", "--rays", "8", "--steps", "1", "--workers", "1", "--part", "inerf"]
    monkeypatch.setattr("sys.argv", ["paper_tables.py", PLACE, "--map", PLACE, "--out", str(tmp_path), *few])
    script("paper_tables").main()
    found = json.loads((tmp_path / "inerf_demo_blobs.json").read_text())["results"]
    assert [cell["condition"] for cell in found["cells"]] == ["bid", "inerf"]
    assert [pair["first"] for pair in found["pairs"]] == ["bid", "bid"]  # by each criterion
    assert len((tmp_path / "inerf_demo_blobs.jsonl").read_text().splitlines()) == 2


def test_failures_are_slower_than_any_success_and_equal_among_themselves(script: Script) -> None:
    def group(label: str, *distances: float) -> Group:
        trials = (Trial("m", "d", ("r",), (1.0,), seed) for seed in range(len(distances)))
        found = [trial_result(trial, [1.0, x, x]) for trial, x in zip(trials, distances, strict=True)]
        return replace(grouped(found)[0], label=label)

    test = script("paper_tables").compare_pair
    good, bad, mixed = group("good", *[0.01] * 6), group("bad", *[0.9] * 6), group("mixed", 0.01, 0.9)
    assert test(good, bad, "10%").rates_p == pytest.approx(2 / 924)  # 2 of choose(12, 6)
    assert (test(good, bad, "10%").steps_p, test(bad, bad, "10%").all_p) == (None, 1)
    assert test(good, bad, "10%").all_p == test(bad, good, "10%").all_p < 0.05
    assert test(mixed, mixed, "10%").all_p == pytest.approx(1)


def test_presets_become_settings_of_each_method(script: Script) -> None:
    settings_of_preset = script("paper_tables").preset_settings
    bid = settings_of_preset("paper", {"rays": 7}, "bid")
    assert bid == {
        "rays": 7,
        "pivot": "camera",
        "max_steps": 1000,
        "learning_rate": 0.02,
        "decay": 0.8,
        "decay_steps": 100,
        "depth_scale": 0.1,
        "candidates": 1,
        "box_weight": 0.0,
    }
    assert settings_of_preset("paper-scene", {}, "inerf") == {"max_steps": 1000}
