"""What evaluations keep: results, comparisons, and how they were made."""

from __future__ import annotations

import json
from pathlib import Path

from hypothesis import given, settings
from hypothesis import strategies as st

from bidnerf.evaluation import (
    Comparison,
    ResultTable,
    Trial,
    TrialResult,
    note_run,
    read_runs,
)

# Inside: records of runs with any content, of which a script makes only its own
from bidnerf.evaluation.results import Provenance
from bidnerf_core.io import from_plain
from drawn import record
from refusals import refused
from trial_results import trial_result


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


def test_results_of_a_newer_version_name_it(tmp_path: Path) -> None:
    row = trial_result(Trial("house", "photos", ("a",)), [1.0]).plain()
    (tmp_path / "r.jsonl").write_text(json.dumps(row | {"ink": 1}) + "\n")
    for versions, expected in (
        ({"bidnerf": "99.1"}, "bidnerf 99.1 wrote it, so upgrade bidnerf"),
        ({"bidnerf": "0.0.1"}, "any of"),
        ({}, "any of"),
    ):
        (tmp_path / "r.meta.json").write_text(json.dumps({"runs": [{"versions": versions}]}))
        with refused(where=tmp_path / "r.jsonl", found="no field 'ink'", expected=expected):
            ResultTable.load(tmp_path / "r.jsonl")


@given(run=record(Provenance))
def test_any_run_comes_back_as_it_was(run: Provenance, tmp_path: Path) -> None:
    before = read_runs(tmp_path / "r.jsonl")
    note_run(tmp_path / "r.jsonl", run)
    assert read_runs(tmp_path / "r.jsonl") == [*before, run]
    (tmp_path / "r.meta.json").unlink()
