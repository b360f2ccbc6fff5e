"""Trial results: a table in memory, and a file of one JSON line per trial, each on disk before its trial counts as done."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from bidnerf_core.errors import printable
from bidnerf_core.evaluation.lines import LinesFile, as_line
from bidnerf_core.evaluation.plan import Trial
from bidnerf_core.evaluation.summary import (
    Group,
    Situation,
    Success,
    Summary,
    grouped,
    situation_titles,
    summarize,
)
from bidnerf_core.evaluation.trial import TrialResult
from bidnerf_core.geometry import symbol
from bidnerf_core.io import from_plain, to_plain, write_file
from bidnerf_core.results import CRITERIA

WIDEST_FIRST = 60
"""Maximum number of characters of a line's first cell for it to share the line with the others."""


@dataclass(frozen=True)
class SummaryRow:
    """The statistics of the trials of one condition in one situation, with the words used for these in reports."""

    start: str  # title of the situation
    label: str  # of the condition
    situation: Situation
    statistics: Summary


@dataclass(frozen=True)
class ResultTable:
    """The results of trials. ``str()`` gives a human-readable table."""

    rows: tuple[TrialResult, ...]

    @cached_property
    def groups(self) -> list[Group]:
        """The results by situation (what was to be localized) and by condition (what localized it)."""
        return grouped(self.rows)

    @cached_property
    def summary(self) -> tuple[SummaryRow, ...]:
        """Success rates with Wilson's 95 % intervals, errors and cost of each group."""
        titles = situation_titles([group.situation for group in self.groups])
        return tuple(
            SummaryRow(titles[g.situation], g.label, g.situation, summarize(g.results)) for g in self.groups
        )

    def __str__(self) -> str:
        lines = [["success by", "n", "frames", *CRITERIA, "median error"]]
        start = None
        for row in self.summary:
            if row.start != start:
                lines.append([row.start])
                start = row.start
            known = row.statistics
            rates = [rate_text(success) for success in known.criteria.values()]
            error = "-"
            if known.translation is not None and known.rotation_deg is not None:
                error = f"{known.translation:.3f} {symbol(known.unit)} {known.rotation_deg:6.2f} deg"
            lines.append([f"  {row.label}", str(known.trials), str(known.frames), *rates, error])
        return aligned(lines)

    def save(self, path: str | Path) -> None:
        """Write the results as JSON lines, which ``bidnerf report`` reads; an existing file is replaced as a whole."""
        write_file(Path(path), b"".join(as_line(to_plain(row)) for row in self.rows))

    @classmethod
    def load(cls, *paths: str | Path) -> ResultTable:
        """Load the results in files, as ``read_results`` does."""
        return cls(tuple(read_results(map(Path, paths))))


def rate_text(success: Success | None) -> str:
    """Format the fraction of trials that met a criterion with its interval; a dash if the criterion does not apply."""
    if success is None:
        return "-"
    rate = success.rate
    return f"{100 * rate.rate:.0f} % ({100 * rate.low:.0f}-{100 * rate.high:.0f})"


def aligned(lines: Sequence[Sequence[str]]) -> str:
    """Format lines of cells as text: the first column is flush left and the others are flush right.

    A line with a single cell is a heading, which may be wider than its column; a very wide first cell takes a
    line of its own. Characters that could control a terminal are escaped.
    """
    cells: list[list[str]] = []
    for line in lines:
        first, *others = map(printable, line)
        cells += [[first], ["", *others]] if others and len(first) > WIDEST_FIRST else [[first, *others]]
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
    return json.dumps(to_plain(trial.portable), sort_keys=True)


def read_results(paths: Iterable[Path]) -> list[TrialResult]:
    """Return the results of all files in order; a result in several files is returned once.

    An incomplete last line is ignored. Raises ``InputError`` for a file that cannot be read or contains
    something else.
    """
    found: dict[Any, TrialResult] = {}
    for path in paths:
        for key, result in ResultsFile.read(path):
            found.setdefault((key, result.weights, result.inputs), result)
    return list(found.values())


class ResultsFile(LinesFile[TrialResult]):
    """A file of results by the key of their trials, see ``key_of``."""

    opening, expected = b'{"T_world_camera": ', "lines as written by 'bidnerf evaluate'"

    @classmethod
    def parsed(cls, plain: Any, where: str) -> tuple[str, TrialResult]:
        result = from_plain(TrialResult, plain, where)
        return key_of(result.trial), result

    def plain(self, key: str, value: TrialResult) -> Any:
        return to_plain(value)

    def __contains__(self, trial: Trial) -> bool:
        return key_of(trial) in self.values

    def __getitem__(self, trial: Trial) -> TrialResult:
        return self.values[key_of(trial)]

    def add(self, result: TrialResult) -> None:
        """Append a result, which is on disk when this returns. Raises ``InputError`` if the file was removed."""
        self.append(key_of(result.trial), result)

    def put_in_order(self, trials: Sequence[Trial]) -> None:
        """Move the results of ``trials`` to the end of the file, in their order, in one atomic step."""
        self.reorder(map(key_of, trials))
