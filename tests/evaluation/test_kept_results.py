"""What evaluations keep: results, comparisons, and how they were made."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from types import SimpleNamespace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bidnerf_core.evaluation import (
    Comparison,
    ResultTable,
    TrialResult,
    note_run,
    read_runs,
)

# Inside: records of runs with any content, of which a script makes only its own
from bidnerf_core.evaluation.results import Provenance, provenance
from bidnerf_core.io import from_plain
from drawn import record


@given(results=st.lists(record(TrialResult), max_size=2, unique_by=lambda result: result.weights))
def test_any_results_come_back_as_they_were(results: list[TrialResult], tmp_path: Path) -> None:
    table = ResultTable(tuple(results))
    table.save(tmp_path / "r.jsonl")
    assert ResultTable.load(tmp_path / "r.jsonl") == table


@settings(max_examples=20)
@given(compared=record(Comparison))
def test_any_comparison_comes_back_as_it_was(compared: Comparison, tmp_path: Path) -> None:
    compared.save(tmp_path / "c.json")
    assert from_plain(Comparison, json.loads((tmp_path / "c.json").read_text()), "c.json") == compared


@given(run=record(Provenance))
def test_any_run_comes_back_as_it_was(run: Provenance, tmp_path: Path) -> None:
    before = read_runs(tmp_path / "r.jsonl")
    note_run(tmp_path / "r.jsonl", run)
    assert read_runs(tmp_path / "r.jsonl") == [*before, run]
    (tmp_path / "r.meta.json").unlink()


def test_the_commit_is_that_of_the_checkout_an_unchanged_installation_is_from(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    checkout, installed = tmp_path / "check out", tmp_path / "site"
    for folder in (checkout, installed):
        (folder / "bidnerf_core").mkdir(parents=True)
        (folder / "bidnerf_core" / "__init__.py").write_text("code")
    for words in ("init -q", "add .", "-c user.name=a -c user.email=a@b commit -q -m first"):
        subprocess.run(["git", *words.split()], cwd=checkout, check=True)
    monkeypatch.setattr("bidnerf_core.__file__", str(installed / "bidnerf_core" / "__init__.py"))
    stated = SimpleNamespace(read_text=lambda _: json.dumps({"url": checkout.as_uri()}))
    monkeypatch.setitem(provenance.__globals__, "distribution", lambda _: stated)
    head = subprocess.run(["git", "rev-parse", "HEAD"], cwd=checkout, check=True, capture_output=True)
    assert provenance("x", "y").commit == head.stdout.decode().strip()
    (checkout / "bidnerf_core" / "__init__.py").write_text("other code")
    assert provenance("x", "y").commit is None
