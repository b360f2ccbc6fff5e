"""What evaluations and scripts keep: results, rows by key that survive a kill, and records with how they were made."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bidnerf_core.evaluation import (
    Comparison,
    ResultTable,
    RowStore,
    TrialResult,
    note_run,
    read_runs,
    write_record,
)

# Inside: records of runs with any content, of which a script makes only its own
from bidnerf_core.evaluation.provenance import Provenance
from bidnerf_core.io import FileInUse, from_plain
from drawn import record
from refusals import refused


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


def test_a_script_goes_on_where_it_was_killed(tmp_path: Path) -> None:
    path = tmp_path / "rows.jsonl"
    with RowStore(path) as store:
        assert [store.get(["a", n], lambda n=n: {"value": n}) for n in (1, 2)] == [{"value": 1}, {"value": 2}]
    whole = path.read_bytes()
    path.write_bytes(whole[:-5])  # a kill in the middle of the second row
    made: list[int] = []

    def make() -> dict[str, int]:
        made.append(2)
        return {"value": 2}

    with RowStore(path) as store:
        assert store.get(["a", 1], make) == {"value": 1}
        assert made == []
        assert store.get(["a", 2], make) == store.get(["a", 2], make) == {"value": 2}
        with refused(where=path, found="another process", error=FileInUse), RowStore(path):
            pass
    assert made == [2]
    assert path.read_bytes() == whole


def test_rows_of_something_else_are_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "rows.jsonl"
    for content, found in (
        ("notes\n", "not JSON"),
        ('{"a": 1}\n', "no key and row"),
        ("[1]\n", "no key and row"),
    ):
        path.write_text(content)
        expected = "lines in the format of benchmark rows"
        with refused(where=f"{path}: line 1", found=found, expected=expected), RowStore(path):
            pass
        assert path.read_text() == content


def test_a_record_holds_its_results_and_how_they_were_made(tmp_path: Path) -> None:
    path = write_record(tmp_path / "new" / "speed.json", {"rate": 0.5}, seed=3)
    record = json.loads(path.read_text())
    assert (record["benchmark"], record["seed"], record["results"]) == ("speed", 3, {"rate": 0.5})
    assert record["command"].startswith("python ")
    assert {"commit", "dirty", "cpu", "date", "versions", "workers"} <= record.keys()
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_record(path, {"rate": float("nan")}, seed=3)
    assert json.loads(path.read_text()) == record
