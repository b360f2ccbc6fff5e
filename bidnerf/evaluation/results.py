"""Trial results: a table in memory, a file with one JSON line per trial, and the runs that made such a file.

Each line is on disk before its trial counts as done.
"""

from __future__ import annotations

import json
import os
import platform
import re
import shlex
import subprocess
import sys
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cached_property
from importlib.metadata import version
from itertools import groupby
from operator import attrgetter
from pathlib import Path
from typing import Any, BinaryIO

import psutil
import torch

import bidnerf_core
from bidnerf.evaluation.plan import Trial
from bidnerf.evaluation.summary import ResultGroup, group_results
from bidnerf.evaluation.trial import TrialResult
from bidnerf.results import CRITERIA
from bidnerf_core.errors import InputError, printable
from bidnerf_core.geometry import symbol
from bidnerf_core.installation import with_writer
from bidnerf_core.io import (
    FileInUse,
    from_plain,
    library_errors,
    open_binary,
    parse_json,
    read_file,
    read_open_file,
    read_record,
    take_lock,
    to_plain,
    write_file,
)
from bidnerf_core.settings import to_flat

LARGEST_FILE = 512 * 2**20
"""Largest size of a file of results in bytes. A trial takes a few kilobytes, so that a hundred thousand trials fit."""
EXPECTED_RESULTS = "lines as written by 'bidnerf evaluate'"
BEGINNING = b'{"T_world_camera": '
"""The beginning of each line of a file of results."""


@dataclass(frozen=True)
class ResultTable:
    """The results of trials. ``str()`` gives a human-readable table."""

    rows: tuple[TrialResult, ...]

    @cached_property
    def groups(self) -> list[ResultGroup]:
        """The results, grouped by situation (what was to be localized) and condition (what localized it)."""
        return group_results(self.rows)

    def __str__(self) -> str:
        lines = [["success by", "n", "frames", *CRITERIA, "median error"]]
        for title, groups in groupby(self.groups, attrgetter("title")):
            lines.append([title])
            for group in groups:
                summary, error = group.summary, "-"
                rates = [
                    f"{100 * s.rate.rate:.0f} % ({100 * s.rate.low:.0f}-{100 * s.rate.high:.0f})" if s else "-"
                    for s in summary.success.values()
                ]
                if summary.translation is not None and summary.rotation_deg is not None:
                    error = f"{summary.translation:.3f} {symbol(summary.unit)} {summary.rotation_deg:6.2f} deg"
                lines.append([f"  {group.label}", str(summary.trials), str(summary.frames), *rates, error])
        return align_cells(lines)

    def save(self, path: str | Path) -> None:
        """Write the results as JSON lines, which ``bidnerf report`` reads; an existing file is replaced as a whole."""
        write_file(Path(path), b"".join(as_line(row.plain()) for row in self.rows))

    @classmethod
    def load(cls, *paths: str | Path) -> ResultTable:
        """Load the results in files, as ``read_results`` does."""
        return cls(tuple(read_results(map(Path, paths))))


def align_cells(lines: Sequence[Sequence[str]]) -> str:
    """Format lines of cells as text: the first column is flush left and the others are flush right.

    A line with a single cell is a heading, which may be wider than its column; a very wide first cell is put
    on a separate line. Characters that could control a terminal are escaped.
    """
    cells: list[list[str]] = []
    for line in lines:
        first, *others = map(printable, line)
        # A first cell that is too wide is put on a separate line.
        cells += [[first], ["", *others]] if others and len(first) > 60 else [[first, *others]]
    columns = [[line[i] for line in cells if len(line) > max(i, 1)] for i in range(max(map(len, cells)))]
    widths = [max(map(len, column)) for column in columns]
    return "\n".join(
        "  ".join(
            [line[0].ljust(widths[0]), *(c.rjust(w) for c, w in zip(line[1:], widths[1:], strict=False))]
        ).rstrip()
        for line in cells
    )


def key_of(trial: Trial) -> str:
    """Return a key that is equal for two trials if and only if they are the same trial, wherever their folders are."""
    return json.dumps(to_flat(trial.portable), sort_keys=True)


def read_results(paths: Iterable[Path]) -> list[TrialResult]:
    """Return the results of all files in order; a result in several files is returned once.

    An incomplete last line is ignored. Raises ``InputError`` for a file that cannot be read or contains
    anything but results.
    """
    results: dict[Any, TrialResult] = {}
    for path in paths:
        for result in _parse(path, read_file(path, EXPECTED_RESULTS, LARGEST_FILE))[0]:
            results.setdefault((key_of(result.trial), result.weights, result.inputs), result)
    return list(results.values())


def _parse(path: Path, content: bytes) -> tuple[list[TrialResult], int]:
    """Return the result of each complete line, and the number of bytes in these lines."""
    lines, results, length = content.split(b"\n"), list[TrialResult](), 0
    for number, line in enumerate(lines, start=1):
        where = f"{path}: line {number}"
        try:
            plain = parse_json(line, where, EXPECTED_RESULTS) if line.strip() else None
        except InputError:
            # The last line is dropped only if it begins as a result does, so that no unrelated file is truncated.
            if number == len(lines) and (line.startswith(BEGINNING) or BEGINNING.startswith(line)):
                break
            raise
        if plain is not None:
            try:
                results.append(from_plain(TrialResult, plain, where))
            except InputError as error:
                stated = InputError(error, expected=error.expected or EXPECTED_RESULTS)
                raise with_writer(stated, *_writers(path)) from error
        length += len(line) + (number < len(lines))
    return results, length


class ResultsFile:
    """A file of results, one JSON object per line, locked by the process that has it open. Use it as a context manager.

    The file stays valid if the process is killed at any moment: a line is on disk before its trial counts as done, and an
    incomplete last line is removed when the file is next opened. Any other line that is not a result raises an error that
    names the line, and is never deleted. Without a path, results are kept in memory only.
    """

    def __init__(self, path: Path | None) -> None:
        self.path = path
        self.values: dict[str, TrialResult] = {}  # by the ``key_of`` of their trials
        self._file: BinaryIO | None = None

    def __enter__(self) -> ResultsFile:
        if self.path is None:
            return self
        file = self._open(self.path)
        try:
            content = read_open_file(file, self.path, EXPECTED_RESULTS, LARGEST_FILE)
            results, complete = _parse(self.path, content)
            for result in results:
                self.values.setdefault(key_of(result.trial), result)
            if complete < len(content):
                file.truncate(complete)
            if complete and content[complete - 1 : complete] != b"\n":
                file.write(b"\n")
            file.flush()
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        if self._file is not None:
            self._file.close()
            self._file = None

    def __contains__(self, trial: Trial) -> bool:
        return key_of(trial) in self.values

    def __getitem__(self, trial: Trial) -> TrialResult:
        return self.values[key_of(trial)]

    def add(self, result: TrialResult) -> None:
        """Append a result and write it to disk before returning. Raises ``InputError`` if the file was removed."""
        if self.path is not None:
            file = self._unmoved(self.path)
            file.write(as_line(result.plain()))
            file.flush()
            os.fsync(file.fileno())
        self.values[key_of(result.trial)] = result

    def put_in_order(self, trials: Sequence[Trial]) -> None:
        """Move the results of ``trials`` to the end of the file, in their order, in one atomic step."""
        last = dict.fromkeys(key for key in map(key_of, trials) if key in self.values)
        order = [*(key for key in self.values if key not in last), *last]
        if self.path is not None:
            self._unmoved(self.path)
            if order != list(self.values):
                ResultTable(tuple(self.values[key] for key in order)).save(self.path)
                self.__exit__()  # the file that is open is the one that was replaced
                self._open(self.path)
        self.values = {key: self.values[key] for key in order}

    def _unmoved(self, path: Path) -> BinaryIO:
        """Return the open file. Raises ``InputError`` if it is no longer at ``path``, since lines would be lost."""
        assert self._file is not None
        if not (path.exists() and os.path.samestat(os.fstat(self._file.fileno()), path.stat())):
            raise InputError(
                "was removed or replaced while it was being written, so its content is lost; start again, or"
                " move the file back",
                where=path,
            )
        return self._file

    def _open(self, path: Path) -> BinaryIO:
        """Open the file, creating it if needed, and lock it."""
        with library_errors(path, "cannot be written", "a file", OSError):
            path.parent.mkdir(parents=True, exist_ok=True)
            if path.exists():
                open_binary(path, EXPECTED_RESULTS).close()  # raises for a pipe, which would wait for a reader
            self._file = path.open("a+b")
        if not take_lock(self._file.fileno()):
            self.__exit__()
            raise FileInUse("another process is writing to it; name another file (`out`)", where=path)
        self._file.seek(0)
        return self._file


def as_line(plain: Any) -> bytes:
    """Return ``plain`` as one line of strict JSON."""
    return json.dumps(plain, allow_nan=False).encode() + b"\n"


# How results were made: command, code and machine.

CHECKOUT = Path(bidnerf_core.__file__).resolve().parents[1]
"""The folder of the code, which is a checkout unless the package is installed."""
RUNS = ".meta.json"
"""The ending of the file next to a results file that lists the runs that made it."""


@dataclass(frozen=True)
class Provenance:
    """When, how and where a run took place."""

    date: str  # UTC, when it began
    command: str
    commit: str | None  # of the checkout that the code was run from
    dirty: bool  # whether files of that checkout were modified
    cpu: str
    cores: int | None
    gpu: str | None
    memory_bytes: int | None
    system: str
    python: str
    versions: dict[str, str]
    workers: str  # a description of the workers that ran the trials


def provenance(command: str, workers: str) -> Provenance:
    """Return the provenance of a run that begins now; ``workers`` describes what runs it."""
    # Uncommitted changes in these folders make a run irreproducible from its commit.
    sources = ("bidnerf", "bidnerf_core", "backends", "plugins", "benchmarks", ":!benchmarks/results")
    return Provenance(
        date=datetime.now(UTC).isoformat(timespec="seconds"),
        command=command,
        commit=_git("rev-parse", "--verify", "HEAD") or None,
        dirty=bool(_git("status", "--porcelain", "--untracked-files=no", "--", *sources)),
        cpu=_cpu_model(),
        cores=os.cpu_count(),
        gpu=torch.cuda.get_device_name() if torch.cuda.is_available() else None,
        memory_bytes=psutil.virtual_memory().total,
        system=f"{platform.system()} {platform.machine()}",
        python=platform.python_version(),
        versions={name: version(name) for name in ("bidnerf", "torch", "numpy", "scipy", "kornia")}
        | {"torch": str(torch.__version__)},
        workers=workers,
    )


def note_run(results: Path, run: Provenance) -> None:
    """Append a run to the list next to a results file, which may take several runs to complete."""
    runs = [*read_runs(results), run]
    write_file(results.with_suffix(RUNS), (json.dumps({"runs": to_plain(runs)}, indent=1) + "\n").encode())


def _writers(results: Path) -> list[Any]:
    """Return the versions of bidnerf that wrote a results file, as far as they are recorded next to it."""
    with suppress(InputError, KeyError, TypeError):  # no record of the runs, or another one
        return [run["versions"]["bidnerf"] for run in read_record(results.with_suffix(RUNS)).items("runs") or ()]
    return []


def read_runs(results: Path) -> list[Provenance]:
    """Return the runs that made a results file, in order; empty if there is no list of them next to the file."""
    path = results.with_suffix(RUNS)
    if not path.is_file():
        return []
    expected = "the list that 'bidnerf evaluate' writes next to its results"
    runs = read_record(path, expected).items("runs")
    if runs is None:
        raise InputError("not a list of runs", where=path, expected=expected)
    return [from_plain(Provenance, run, str(path)) for run in runs]


def _git(*arguments: str) -> str:
    """Return the output of a git command in this package's checkout; empty if there is no checkout or no git."""
    if (CHECKOUT / ".git").exists():  # an installed package may lie inside another project
        with suppress(OSError, subprocess.CalledProcessError):
            return subprocess.check_output(
                ["git", *arguments], cwd=CHECKOUT, stderr=subprocess.DEVNULL, text=True
            ).strip()
    return ""


def _cpu_model() -> str:
    """Return the name of the processor."""
    with suppress(OSError):
        if model := re.search(r"^model name\s*:(.*)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE):
            return model[1].strip()
    return platform.processor()


def script_command() -> str:
    """Return the command of the running script, with paths relative to the checkout; outside it, only file names."""

    def shorten(part: str) -> str:
        path = Path(part)
        inside = path.relative_to(CHECKOUT) if path.is_relative_to(CHECKOUT) else path.name
        return str(inside) if path.is_absolute() else part

    # Words such as ``--out=PATH`` and ``MAP:DATA`` hold paths, too.
    words = ["".join(map(shorten, re.split(r"([=:])", word))) for word in sys.argv]
    # The program may be installed anywhere.
    return shlex.join(["bidnerf", *words[1:]] if Path(words[0]).stem == "bidnerf" else ["python", *words])
