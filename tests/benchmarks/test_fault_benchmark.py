"""The benchmark of faults: its counts, its choice of frames and faults, and how it goes on after an interruption."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from scipy.stats import chi2

import tiny
from bidnerf.evaluation import FAULTS, NO_FAULT
from bidnerf_core.registry import registered
from localizations import answer_row


@pytest.fixture
def faults(script: Callable[[str], ModuleType]) -> ModuleType:
    return script("faults")


def row(right: bool, converged: bool, squared: float | None = None) -> Any:
    return answer_row(0.01 if right else 1.0, converged, squared, cpu_seconds=2.0)


def test_a_cell_counts_silent_and_rejected_answers(faults: ModuleType) -> None:
    bound = float(chi2.ppf(0.95, 6))
    rows = [
        row(True, True, bound - 0.1),
        row(True, True, bound + 0.1),
        row(True, False, 1.0),
        row(False, True),
    ]
    rows.append(row(False, False) | {"translation": None, "rotation_deg": None})  # of another scene
    found = faults.summary(rows)
    assert {name: found[name] for name in ("n", "right", "strict", "converged", "silent", "right_but_rejected")} == {
        "n": 5,
        "right": 3,
        "strict": 3,
        "converged": 3,
        "silent": 1,
        "right_but_rejected": 1,
    }
    assert found["inside_95_of_converged"] == [1, 2]
    assert "silent    1" in faults.line("cell", rows)


@pytest.fixture(scope="module")
def scene(shared: Path, tmp_path_factory: pytest.TempPathFactory) -> str:
    """A map and a dataset of the same scene, as the script takes them."""
    data = tiny.write_dataset(tmp_path_factory.mktemp("faults") / "data", train=1, test=12)
    return f"{shared / 'map'}:{data}"


def given(faults: ModuleType, monkeypatch: pytest.MonkeyPatch, *words: str) -> Any:
    monkeypatch.setattr("sys.argv", ["faults.py", *words])
    return faults.arguments()


def test_frames_for_tuning_and_for_reports_are_disjoint(
    faults: ModuleType, scene: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    cell = ["--faults", "none", "--rgb"]
    tuning = [q.frame for q in faults.queries(given(faults, monkeypatch, scene, *cell, "--tuning-frames"))]
    report = [q.frame for q in faults.queries(given(faults, monkeypatch, scene, *cell))]
    assert tuning == ["t_0001", "t_0006", "t_0011"]
    assert sorted(tuning + report) == [f"t_{i:04d}" for i in range(12)]
    few = [q.frame for q in faults.queries(given(faults, monkeypatch, scene, *cell, "--frames", "3"))]
    assert few == [report[0], report[3], report[6]]


def test_all_faults_are_tried_that_change_the_input(
    faults: ModuleType, scene: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = list(faults.queries(given(faults, monkeypatch, scene, "--frames", "1")))
    by_mode = {mode: {q.cell[2] for q in found if q.cell[1] == mode} for mode in ("RGB", "RGB-D")}
    everything = {NO_FAULT, *(f"{name}:{size:g}" for name, fault in FAULTS.items() for size in fault.sizes)}
    assert by_mode["RGB-D"] == everything
    blind = {NO_FAULT, *(f"{n}:{s:g}" for n, f in FAULTS.items() for s in f.sizes if not f.needs_depth)}
    assert by_mode["RGB"] == blind
    other = given(faults, monkeypatch, scene, "--faults", "none", "--rgb", "--foreign", scene.split(":")[1])
    assert not any(q.foreign for q in faults.queries(other))  # its own dataset is not another scene


def test_an_interrupted_run_goes_on_with_rows_of_the_same_content(
    faults: ModuleType, scene: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    answered: list[str] = []

    def answer(query: Any) -> dict[str, Any]:
        answered.append(f"{query.cell[2]} {query.frame}")
        return row(True, True, 1.0)

    monkeypatch.setattr(faults, "answer", answer)

    def run(jobs: int, *names: str) -> dict[str, Any]:
        words = [scene, "--faults", *names, "--rgbd", "--frames", "3", "--jobs", str(jobs)]
        with faults.RowStore(tmp_path / "rows.jsonl") as store, ThreadPoolExecutor(1) as executor:
            measured: dict[str, Any] = faults.measure(given(faults, monkeypatch, *words), store, executor)
            return measured

    assert run(1, "none")["all"]["n"] == 3
    assert len(answered) == 3
    both = run(2, "none", "mirror")
    assert len(answered) == 6
    assert list(both["cells"]["map"]["RGB-D"]) == ["none", "mirror:1"]
    other = dataclasses.replace(FAULTS["mirror"], change=FAULTS["flip"].change)
    monkeypatch.setitem(registered, ("faults", "mirror"), other)
    run(1, "none", "mirror")
    assert [words.split()[0] for words in answered[6:]] == ["mirror:1"] * 3  # those images are others now


def test_unknown_diagnostics_are_left_out(faults: ModuleType) -> None:
    @dataclasses.dataclass(frozen=True)
    class Diagnostics:
        inliers: int = 0
        evidence: float = math.nan

    @dataclasses.dataclass(frozen=True)
    class Answer:
        diagnostics: Diagnostics | None = None

    assert faults.diagnostics_of(Answer()) == {}
    assert faults.diagnostics_of(Answer(Diagnostics())) == {"diagnostics": {"inliers": 0}}
    known = {"inliers": 9, "evidence": 0.5}
    assert faults.diagnostics_of(Answer(Diagnostics(**known))) == {"diagnostics": known}
