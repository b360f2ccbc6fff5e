"""Wrong command lines and their answers, in ``wrong_arguments.txt``; what needs no content of files is answered without torch."""

from __future__ import annotations

import json
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from bidnerf.cli import COMMANDS

# Inside: the declarations of all arguments
from bidnerf.cli.parameters import Check, leaves
from commands import Run
from wrong_arguments import CASES, Answer, Case, make_place

PROGRAM = Path(__file__).with_name("wrong_arguments.py")
OUTPUTS = {"--out", "--plot", "--save", "--draw"}
"""Options that name what a command writes, which is checked by the command itself."""

IMAGE_FILES = {"camera", "images", "register_depth", "masks"}
"""Options for reading images that name files or folders."""


@pytest.fixture(scope="module")
def place(shared: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with what the command lines name."""
    return make_place(tmp_path_factory.mktemp("place"), shared)


@pytest.mark.parametrize("case", CASES, ids=[case.line for case in CASES])
def test_a_wrong_command_line_is_answered_in_one_line_and_leaves_nothing(
    case: Case, bidnerf: Run, place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(place)
    before = sorted(place.rglob("*"))
    found = bidnerf(*shlex.split(case.line))
    command, help_page = case.line.split()[0], f"; 'bidnerf {case.line.split()[0]} --help' describes all arguments"
    expected = f"bidnerf {command}: {case.answer}"
    if case.answer.endswith("..."):
        assert found.err.startswith(expected.removesuffix("...").rstrip())
    else:
        assert found.err.removesuffix("\n").removesuffix(help_page) == expected
    assert (found.status, found.out, found.err.count("\n")) == (case.status, "", 1)
    assert sorted(place.rglob("*")) == before


def test_an_answer_that_needs_no_content_of_files_is_given_without_torch(place: Path) -> None:
    command = [sys.executable, PROGRAM, "--blocked", place]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    answers = [Answer(*json.loads(line)) for line in done.stdout.splitlines()]
    assert {c.line: (c.reads, c.reads or c.status) for c in CASES} == {
        case.line: (answer.torch, answer.torch or answer.status) for case, answer in zip(CASES, answers, strict=True)
    }
    # Half a second on an idle core; CPU time is up to twice as long on a busy machine.
    assert [case.line for case, answer in zip(CASES, answers, strict=True) if answer.seconds > 1] == []


def test_every_path_is_checked_before_anything_is_loaded() -> None:
    """Whatever a command reads has a check among its annotations, or is one of the images' files, which share one."""
    unchecked = {
        (name, parameter.flag)
        for name in COMMANDS
        for parameter, _ in leaves(COMMANDS[name], {})
        if "Path" in str(parameter.hint) and parameter.note(Check) is None and parameter.name not in IMAGE_FILES
    }
    assert {each for each in unchecked if each[1] not in OUTPUTS} == {
        ("localize", "--map"),  # the command finds out where the maps end and the queries begin
        ("serve", "--token-file"),
    }


def test_the_table_is_complete() -> None:
    assert len(CASES) >= 100
    assert {case.line.split()[0] for case in CASES} >= {
        "localize",
        "track",
        "train",
        "poses",
        "view",
        "serve",
        "export",
    }
