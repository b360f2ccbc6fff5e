"""Faults in trials, results, reports and the benchmark: they are part of what a trial is, and counted by size."""

from __future__ import annotations

import dataclasses
import importlib
import math
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
from scipy.stats import chi2

import tiny
from bidnerf.cli import main
from bidnerf.evaluation import (
    FAULTS,
    NO_FAULT,
    Plan,
    ResultsFile,
    Trial,
    faulty,
    key_of,
    list_trials,
    missing_trials,
)

# Inside: the images of a trial
from bidnerf.evaluation.run import InThisProcess
from bidnerf.evaluation.trial import trial_views
from bidnerf.scenes import closed_form_data
from bidnerf_core.registry import registered
from refusals import refused

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
pytestmark = pytest.mark.usefixtures("small_images")
QUICK = ["--method", "bid", "--rays", "16", "--max-steps", "2", "--workers", "1", "--size", "0.3"]


def trial(fault: str = NO_FAULT, seed: int = 0) -> Trial:
    return Trial("demo:blobs", "demo:blobs", ("0003",), (), seed, fault)


def trials_of(**options: Any) -> list[Trial]:
    return list_trials(Plan(**options), "demo:blobs", "demo:blobs", closed_form_data("demo:blobs"))


def test_a_plan_tries_each_fault_on_the_same_frames() -> None:
    faults = ("none", "depth-scale:1.02", "exposure:0.7+blur:3")
    trials = trials_of(trials=3, faults=faults)
    assert [t.fault for t in trials] == [fault for fault in faults for _ in range(3)]
    assert len({(t.frames, t.seed) for t in trials}) == 3
    assert len({key_of(t) for t in trials}) == 9
    with refused(found="fault depth-scale:1.02 changes the measured depth, which the method does not receive"):
        trials_of(depth=False, faults=faults)
    with refused(found="no fault 'blurr', did you mean 'blur'?"):
        Plan(faults=["blurr:1"])


def test_the_method_gets_the_faulty_views() -> None:
    data = closed_form_data("demo:blobs")
    (clean,), (bad,) = trial_views(trial(), data), trial_views(trial("depth-scale:1.02", 4), data)
    assert clean.frame.depth is not None
    assert bad.frame.depth is not None
    assert torch.equal(bad.frame.depth, clean.frame.depth * 1.02)
    (blind,) = trial_views(dataclasses.replace(trial("occluder:0.2"), depth=False), data)
    assert blind.frame.depth is None
    assert torch.equal(blind.frame.rgb, faulty(clean, "occluder:0.2", 0).frame.rgb)


def test_results_notice_when_a_fault_has_changed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    words = ["evaluate", "demo:blobs", "--out", str(tmp_path / "r.jsonl"), *QUICK, "--trials", "1"]
    words += ["--fault", "exposure:0.7"]
    assert main(words) == 0
    trials = trials_of(
        protocol="bid",
        sizes=[0.3],
        trials=1,
        method="bid",
        faults=["exposure:0.7"],
        config='{"max_steps": 2, "rays": 16}',
    )
    with ResultsFile(tmp_path / "r.jsonl") as file:
        assert missing_trials(trials, file) == []
        other = dataclasses.replace(FAULTS["exposure"], change=FAULTS["blur"].change)
        monkeypatch.setitem(registered, ("faults", "exposure"), other)
        with refused(where=tmp_path / "r.jsonl", found="made with other images"):
            missing_trials(trials, file)


# The benchmark.


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return importlib.import_module("faults")


def row(right: bool, converged: bool, squared: float | None = None) -> dict[str, Any]:
    error = 0.01 if right else 1.0
    return {
        "translation": error,
        "rotation_deg": error,
        "converged": converged,
        "normalized_error_squared": squared,
        "cpu_seconds": 2.0,
    }


def test_a_cell_counts_silent_and_rejected_answers(script: ModuleType) -> None:
    bound = float(chi2.ppf(0.95, 6))
    rows = [
        row(True, True, bound - 0.1),
        row(True, True, bound + 0.1),
        row(True, False, 1.0),
        row(False, True),
    ]
    rows.append(row(False, False) | {"translation": None, "rotation_deg": None})  # of another scene
    found = script.summary(rows)
    assert {name: found[name] for name in ("n", "right", "strict", "converged", "silent", "right_but_rejected")} == {
        "n": 5,
        "right": 3,
        "strict": 3,
        "converged": 3,
        "silent": 1,
        "right_but_rejected": 1,
    }
    assert found["inside_95_of_converged"] == [1, 2]
    assert "silent    1" in script.line("cell", rows)


@pytest.fixture(scope="module")
def scene(shared: Path, tmp_path_factory: pytest.TempPathFactory) -> str:
    """A map and a dataset of the same scene, as the script takes them."""
    data = tiny.write_dataset(tmp_path_factory.mktemp("faults") / "data", train=1, test=12)
    return f"{shared / 'map'}:{data}"


def given(script: ModuleType, monkeypatch: pytest.MonkeyPatch, *words: str) -> Any:
    monkeypatch.setattr("sys.argv", ["faults.py", *words])
    return script.arguments()


def test_frames_for_tuning_and_for_reports_are_disjoint(
    script: ModuleType, scene: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    cell = ["--faults", "none", "--rgb"]
    tuning = [q.frame for q in script.queries(given(script, monkeypatch, scene, *cell, "--tuning-frames"))]
    report = [q.frame for q in script.queries(given(script, monkeypatch, scene, *cell))]
    assert tuning == ["t_0001", "t_0006", "t_0011"]
    assert sorted(tuning + report) == [f"t_{i:04d}" for i in range(12)]
    few = [q.frame for q in script.queries(given(script, monkeypatch, scene, *cell, "--frames", "3"))]
    assert few == [report[0], report[3], report[6]]


def test_all_faults_are_tried_that_change_the_input(
    script: ModuleType, scene: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = list(script.queries(given(script, monkeypatch, scene, "--frames", "1")))
    by_mode = {mode: {q.cell[2] for q in found if q.cell[1] == mode} for mode in ("RGB", "RGB-D")}
    everything = {NO_FAULT, *(f"{name}:{size:g}" for name, fault in FAULTS.items() for size in fault.sizes)}
    assert by_mode["RGB-D"] == everything
    blind = {NO_FAULT, *(f"{n}:{s:g}" for n, f in FAULTS.items() for s in f.sizes if not f.needs_depth)}
    assert by_mode["RGB"] == blind
    other = given(script, monkeypatch, scene, "--faults", "none", "--rgb", "--foreign", scene.split(":")[1])
    assert not any(q.foreign for q in script.queries(other))  # its own dataset is not another scene


def test_an_interrupted_run_goes_on_with_rows_of_the_same_content(
    script: ModuleType, scene: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[str] = []

    def answer(query: Any) -> dict[str, Any]:
        asked.append(f"{query.cell[2]} {query.frame}")
        return row(True, True, 1.0)

    monkeypatch.setattr(script, "answer", answer)

    def run(jobs: int, *faults: str) -> dict[str, Any]:
        words = [scene, "--faults", *faults, "--rgbd", "--frames", "3", "--jobs", str(jobs)]
        with script.RowStore(tmp_path / "rows.jsonl") as store:
            found: dict[str, Any] = script.measured(given(script, monkeypatch, *words), store, InThisProcess())
            return found

    assert run(1, "none")["all"]["n"] == 3
    assert len(asked) == 3
    both = run(2, "none", "mirror")
    assert len(asked) == 6
    assert list(both["cells"]["map"]["RGB-D"]) == ["none", "mirror:1"]
    other = dataclasses.replace(FAULTS["mirror"], change=FAULTS["flip"].change)
    monkeypatch.setitem(registered, ("faults", "mirror"), other)
    run(1, "none", "mirror")
    assert [words.split()[0] for words in asked[6:]] == ["mirror:1"] * 3  # those images are others now


def test_unknown_diagnostics_are_left_out(script: ModuleType) -> None:
    @dataclasses.dataclass(frozen=True)
    class Diagnostics:
        inliers: int = 0
        evidence: float = math.nan

    @dataclasses.dataclass(frozen=True)
    class Answer:
        diagnostics: Diagnostics | None = None

    assert script.diagnostics_of(Answer()) == {}
    assert script.diagnostics_of(Answer(Diagnostics())) == {"diagnostics": {"inliers": 0}}
    known = {"inliers": 9, "evidence": 0.5}
    assert script.diagnostics_of(Answer(Diagnostics(**known))) == {"diagnostics": known}
