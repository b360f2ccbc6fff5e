"""A cited record that is older than what it measures is found, unless it is known to be."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest


def test_a_record_is_out_of_date_once_what_it_measures_changes(
    tmp_path: Path, script: Callable[[str], ModuleType], capsys: pytest.CaptureFixture[str]
) -> None:
    def commit(path: str, text: str) -> str:
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).write_text(text)
        user = ["git", "-c", "user.name=a", "-c", "user.email=a@b.c"]
        for words in (["git", "init", "-q"], ["git", "add", "."], [*user, "commit", "-qm", path]):
            subprocess.run(words, cwd=tmp_path, check=True)
        return subprocess.check_output(["git", "rev-parse", "HEAD"], cwd=tmp_path, text=True).strip()

    def check(*words: str) -> tuple[int, str]:
        status = script("stale").main(words, tmp_path)
        return status, capsys.readouterr().err

    commit("docs/results.md", "*Records: `service` (today).*\n")
    known = "benchmarks/results/stale.txt"
    made = {"commit": commit(known, ""), "date": "2026-11-28T00:00:00+00:00"}
    commit("benchmarks/results/service.json", json.dumps(made))
    commit("README.md", "")
    commit("bidnerf_core/mapping/surface.py", "another package\n")
    commit("bidnerf/service/notes.md", "no code\n")
    assert check() == (0, "")
    commit("bidnerf/service/app.py", "changed\n")
    assert check() == (1, "service is newly out of date: make it anew, or list it by --accept\n")
    assert check("--accept") == check() == (0, "")
    assert f"\nservice {made['commit'][:10]}\n" in (tmp_path / known).read_text()
    made["commit"] = commit("benchmarks/results/service.json", "{}")
    commit("benchmarks/results/service.json", json.dumps(made))
    assert check() == (1, "service is listed, but not out of date or not cited: --accept\n")
    made |= {"commit": "0" * 40, "date": "2000-01-01T00:00:00+00:00"}  # of a branch that was rewritten
    commit("benchmarks/results/service.json", json.dumps(made))
    assert check()[0] == 1
