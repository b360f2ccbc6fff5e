"""Run the wrong command lines of ``wrong_arguments.txt``, each in a process of its own, and print their answers and times.

    python tests/cli/wrong_arguments.py [WORDS]      # only those that contain WORDS

Each line has the exit status, the CPU time from the start of Python (seconds), "torch" if torch was imported, and the answer. The folder in
which the commands run is made first, and removed.
"""

from __future__ import annotations

import importlib.abc
import json
import os
import re
import shlex
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple


class Case(NamedTuple):
    """A wrong command line."""

    line: str
    status: int
    reads: bool  # whether the answer needs the content of files or the settings of a plugin, which take torch
    answer: str


CASES = [
    Case(line, int(status), bool(reads), answer)
    for line, status, reads, answer in re.findall(
        r"^\$ bidnerf (.+)\n  (\d)(\+?): (.+)$", Path(__file__).with_suffix(".txt").read_text(), re.MULTILINE
    )
]


def make_place(folder: Path, shared: Path) -> Path:
    """Fill a folder with what the command lines name; ``shared`` holds a tiny dataset and a map of it."""
    for name in ("data", "map"):
        shutil.copytree(shared / name, folder / name)
    for name in ("photos", "empty"):
        (folder / name).mkdir()
    for name in ("photo.png", "photos/0.png", "photos/1.png", "photos/2.png"):
        shutil.copy(shared / "data/images/r_0000.png", folder / name)
    (folder / "start.json").write_text("{}")
    return folder


class NoTorch(importlib.abc.MetaPathFinder):
    """Ends the process with the exit status ``USED`` when it imports torch."""

    USED = 99

    def find_spec(self, name: str, *_: Any) -> None:
        if name == "torch":
            os._exit(self.USED)


class Answer(NamedTuple):
    """What a command line did."""

    status: int
    seconds: float  # of CPU time, from the start of Python
    torch: bool  # whether it was imported
    err: str


def in_a_process(work: Callable[[], int]) -> tuple[int, str]:
    """Return the exit status of ``work`` in a forked process, and what it wrote to stderr."""
    with tempfile.TemporaryFile() as written:
        child = os.fork()
        if not child:
            os.dup2(written.fileno(), 2)
            status = work()
            sys.stderr.flush()
            os._exit(status)
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        written.seek(0)
        return status, written.read().decode()


def answers(folder: Path, cases: list[Case], blocked: bool) -> Iterator[Answer]:
    """Yield the answers to the command lines; if ``blocked``, each ends where it imports torch."""
    from bidnerf.cli import COMMANDS, main

    for name in COMMANDS:
        COMMANDS.load(name)
    os.chdir(folder)
    assert "torch" not in sys.modules
    began = time.process_time()

    def run(case: Case) -> int:
        if blocked:
            sys.meta_path.insert(0, NoTorch())
        since = time.process_time()
        status = main(shlex.split(case.line))
        used = time.process_time() - since
        print(json.dumps([began + used, "torch" in sys.modules]), file=sys.stderr)
        return status

    for case in cases:
        status, err = in_a_process(lambda case=case: run(case))  # type: ignore[misc]
        if status == NoTorch.USED:
            yield Answer(status, 0.0, True, err)
        else:
            *lines, measured = err.splitlines()
            yield Answer(status, *json.loads(measured), "\n".join(lines))


def make_shared(folder: Path) -> int:
    sys.path.insert(0, str(Path(__file__).parents[1] / "support"))
    import tiny
    from bidnerf.cli import main

    tiny.write_dataset(folder / "data")
    return main(["train", str(folder / "data"), "--out", str(folder / "map"), *tiny.options()])


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as shared, tempfile.TemporaryDirectory() as place:
        if "--blocked" in sys.argv:  # for the tests, which have made the folder
            for answer in answers(Path(sys.argv[-1]), CASES, blocked=True):
                print(json.dumps(answer))
        else:
            assert in_a_process(lambda: make_shared(Path(shared)))[0] == 0
            cases = [case for case in CASES if " ".join(sys.argv[1:]) in case.line]
            for case, answer in zip(cases, answers(make_place(Path(place), Path(shared)), cases, False), strict=True):
                print(
                    f"$ bidnerf {case.line}\n  {answer.status} {answer.seconds:.2f} {'torch ' * answer.torch}{answer.err}"
                )
