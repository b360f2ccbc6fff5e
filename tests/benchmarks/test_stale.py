"""A cited record that is older than what it measures is found, unless it is known to be, and made anew by its own command."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

KNOWN = "benchmarks/results/stale.txt"
APP = "bidnerf/service/app.py"
RECORD = "benchmarks/results/service.json"


class Repository:
    """A repository with a record ``service``, which the documentation cites."""

    def __init__(self, folder: Path, stale: ModuleType, capsys: pytest.CaptureFixture[str]) -> None:
        self.folder, self._stale, self._capsys = folder, stale, capsys
        self.commit("docs/results.md", "*Records: `service` (today).*\n")
        self.commit("README.md", "")
        self.record(self.commit(KNOWN, ""))

    def commit(self, path: str, text: str) -> str:
        (self.folder / path).parent.mkdir(parents=True, exist_ok=True)
        (self.folder / path).write_text(text)
        user = ["git", "-c", "user.name=a", "-c", "user.email=a@b.c"]
        for words in (["git", "init", "-q"], ["git", "add", path], [*user, "commit", "-qm", path]):
            subprocess.run(words, cwd=self.folder, check=True)
        return subprocess.check_output(["git", "rev-parse", "HEAD"], cwd=self.folder, text=True).strip()

    def record(self, commit: str, date: str = "2026-11-28T00:00:00+00:00", **more: Any) -> str:
        self.commit(RECORD, json.dumps({"commit": commit, "date": date, **more}))
        return commit

    def check(self, *words: str) -> tuple[int, str]:
        status = self._stale.main(words, self.folder)
        return status, self._capsys.readouterr().err


@pytest.fixture
def repository(tmp_path: Path, script: Callable[[str], ModuleType], capsys: pytest.CaptureFixture[str]) -> Repository:
    return Repository(tmp_path, script("stale"), capsys)


def test_a_record_is_out_of_date_once_what_it_measures_changes(repository: Repository) -> None:
    check, commit, record = repository.check, repository.commit, repository.record
    commit("bidnerf_core/mapping/surface.py", "another = 'package'\n")
    commit("bidnerf/service/notes.md", "no code\n")
    assert check() == (0, "")
    made = record(commit(APP, 'def answer():\n    """Return it."""\n    return 1\n'))
    commit(APP, 'def answer():\n    """Return the answer."""\n    return (1)  # of all\n')
    assert check() == (0, "")
    commit(APP, 'def answer():\n    """Return the answer."""\n    return 2\n')
    assert check() == (1, "service is newly out of date: make it anew, or list it by --accept\n")
    assert check("--accept") == check() == (0, "")
    assert f"\nservice {made[:10]}\n" in (repository.folder / KNOWN).read_text()
    record(commit("bidnerf/service/page.html", "no Python\n"))
    assert check() == (1, "service is listed, but not out of date or not cited: --accept\n")
    assert check("--accept") == (0, "")
    commit("bidnerf/service/page.html", "changed\n")
    assert check()[0] == 1
    record("0" * 40, "2000-01-01T00:00:00+00:00")  # of a branch that was rewritten
    assert check()[0] == 1


def test_a_record_is_made_anew_and_an_interrupted_run_goes_on(repository: Repository) -> None:
    rows = repository.folder / "benchmarks" / "results" / "service.rows.jsonl"
    # The script appends a row, and fails as long as there are fewer than two.
    repository.commit(
        "make.py",
        "import json, subprocess, sys\n"
        "with open(sys.argv[1], 'a+') as rows:\n"
        "    rows.write('a row\\n')\n"
        "    rows.seek(0)\n"
        "    done = len(rows.readlines()) == 2\n"
        "head = subprocess.check_output(['git', 'rev-parse', 'HEAD'], text=True).strip()\n"
        "if done:\n"
        f"    json.dump({{'commit': head, 'date': '', 'command': 'none'}}, open({RECORD!r}, 'w'))\n"
        "sys.exit(not done)\n",
    )
    repository.record("0" * 40, "2000-01-01T00:00:00+00:00", command=f"python make.py '{rows}'")
    repository.commit(APP, "answer = 1\n")
    rows.write_text("rows of an earlier version\n" * 7)
    failed = f"service: FAILED with status 1, see {rows.parent / 'service.log'}\n"
    assert repository.check("--make") == (1, failed)
    repository.commit(APP, "answer = 2\n")  # the row that has been made is no longer of this code
    assert repository.check("--make") == (1, failed)
    repository.commit(APP, "answer = 2  # rows remain\n")
    assert repository.check("--make") == (0, "")
    assert rows.read_text() == "a row\n" * 2
    assert repository.check() == (0, "")


def test_records_depend_on_what_there_is(script: Callable[[str], ModuleType]) -> None:
    stale = script("stale")
    paths = {path for some in stale.MEASURED.values() for path in some}
    assert {path for path in paths if not (stale.ROOT / path).exists()} == set()
