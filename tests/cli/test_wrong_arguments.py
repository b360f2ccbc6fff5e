"""Wrong command lines and their answers, in ``wrong_arguments.txt``; an argument is refused before torch is imported."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from commands import Run

CASES = re.findall(
    r"^\$ bidnerf (.+)\n  (\d): (.+)$", Path(__file__).with_name("wrong_arguments.txt").read_text(), re.MULTILINE
)


@pytest.fixture(scope="module")
def place(shared: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with what the command lines name."""
    folder = tmp_path_factory.mktemp("place")
    for name in ("data", "map"):
        shutil.copytree(shared / name, folder / name)
    for name in ("photos", "empty"):
        (folder / name).mkdir()
    for name in ("photo.png", "photos/0.png", "photos/1.png", "photos/2.png"):
        shutil.copy(shared / "data/images/r_0000.png", folder / name)
    (folder / "start.json").write_text("{}")
    return folder


@pytest.mark.parametrize(("line", "status", "answer"), CASES, ids=[line for line, *_ in CASES])
def test_a_wrong_command_line_is_answered_in_one_line_and_leaves_nothing(
    line: str, status: str, answer: str, bidnerf: Run, place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(place)
    before = sorted(place.rglob("*"))
    found = bidnerf(*line.split())
    command, help_page = line.split()[0], f"; 'bidnerf {line.split()[0]} --help' describes all arguments"
    expected = f"bidnerf {command}: {answer}"
    if answer.endswith("..."):
        assert found.err.startswith(expected.removesuffix("...").rstrip())
    else:
        assert found.err.removesuffix("\n").removesuffix(help_page) == expected
    assert (str(found.status), found.out, found.err.count("\n")) == (status, "", 1)
    assert sorted(place.rglob("*")) == before


def test_the_table_is_complete() -> None:
    assert len(CASES) >= 100
    assert {line.split()[0] for line, *_ in CASES} >= {"localize", "track", "train", "poses", "view", "serve", "export"}


@pytest.mark.parametrize(
    "line",
    [
        "localize",
        "localize MAP",
        "localize MAP q.png --method guess",
        "localize MAP q.png --hfov 200",
        "localize MAP q.png --nope",
        "train DATA --out MAP --outt X",
        "train DATA --out MAP --backend guess",
        "export MAP --to guess --out DIR",
        "evaluate MAP DATA --out R.jsonl --protocol guess",
        "report",
        "compare",
        "view MAP --save page.txt",
        "info MAP --plot page.pdf",
        "plugins guess",
    ],
)
def test_a_wrong_argument_is_refused_without_torch(line: str) -> None:
    program = (
        f"import sys; from bidnerf.cli import main; status = main({line.split()!r});"
        " sys.exit(9 if {'torch', 'kornia', 'scipy', 'cv2'} & {*sys.modules} else status)"
    )
    assert subprocess.run([sys.executable, "-c", program], stderr=subprocess.DEVNULL).returncode == 2
