"""A real dask scheduler with two workers gives what one process gives."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from bidnerf_core.cli import main

pytestmark = pytest.mark.slow


distributed = pytest.importorskip("distributed")

WORDS = ["--trials", "6", "--size", "0.3", "--method", "bid", "--rays", "16", "--max-steps", "2"]


def test_two_dask_workers_give_the_results_of_one_process(tmp_path: Path) -> None:
    alone, together = tmp_path / "alone.jsonl", tmp_path / "together.jsonl"
    assert main(["evaluate", "demo:blobs", "--out", str(alone), "--workers", "1", *WORDS]) == 0
    cluster = distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None, silence_logs=50
    )
    with cluster:
        address = cluster.scheduler_address
        assert main(["evaluate", "demo:blobs", "--out", str(together), "--dask", address, *WORDS]) == 0
    lines = [[json.loads(line) for line in path.read_text().splitlines()] for path in (alone, together)]
    for line in (*lines[0], *lines[1]):
        del line["seconds"], line["peak_memory_bytes"]
    assert lines[0] == lines[1]
    (run,) = json.loads(together.with_suffix(".meta.json").read_text())["runs"]
    assert run["workers"] == "dask, 2 threads"


def test_a_scheduler_that_is_not_there_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("bidnerf_core.evaluation.run.PATIENCE", "1s")
    out = tmp_path / "r.jsonl"
    assert main(["evaluate", "demo:blobs", "--out", str(out), "--dask", "tcp://127.0.0.1:9", *WORDS]) == 1
    said = capsys.readouterr().err.splitlines()
    assert "no dask scheduler at tcp://127.0.0.1:9" in said[-1]
