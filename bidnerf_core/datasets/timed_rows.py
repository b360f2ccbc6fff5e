"""Text files of rows that begin with a time stamp, as in the TUM RGB-D benchmark.

A row is ``timestamp value value ...``, separated by blanks or commas; ``#`` begins a comment, empty lines are skipped, and
Windows line endings are allowed. Rows may be in any order.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from bidnerf_core.errors import InputError
from bidnerf_core.io.files import open_binary

LARGEST_LIST = 256 * 2**20
"""Bytes. A trajectory over a whole day at 100 Hz is about as large."""


@dataclass(frozen=True)
class TimedRow:
    """A row of such a file."""

    where: str  # the file and the line, for messages
    time: float  # seconds
    words: tuple[str, ...]  # what follows the time stamp


def read_timed_rows(path: Path, columns: str) -> list[TimedRow]:
    """Read the rows in chronological order; ``columns`` names the columns after the time stamp ("tx ty tz").

    Raises ``InputError`` where the file is missing, not text, too large or without rows, and for a row with fewer
    entries or without a finite time.
    """
    rows = [
        _row(f"{path}: line {number}", line.replace(",", " ").split(), columns)
        for number, text in enumerate(_lines(path), start=1)
        if (line := text.partition("#")[0].strip())
    ]
    if not rows:
        raise InputError(f"{path}: has no rows, expected lines of timestamp {columns}")
    return sorted(rows, key=lambda row: row.time)


def _row(where: str, words: list[str], columns: str) -> TimedRow:
    expected = f"expected timestamp {columns}"
    count = 1 + len(columns.split())
    if len(words) < count:
        raise InputError(f"{where} has {len(words)} of {count} entries, {expected}")
    try:
        time = float(words[0])
    except ValueError as error:
        raise InputError(f"{where}: {words[0]!r} is no time stamp, {expected}") from error
    if not math.isfinite(time):
        raise InputError(f"{where}: the time stamp is {words[0]}, expected finite seconds")
    return TimedRow(where, time, tuple(words[1:]))


def require_distinct_times(rows: list[TimedRow]) -> None:
    """Raise ``InputError`` where two of the rows, which are in chronological order, have the same time stamp."""
    for row, following in pairwise(rows):
        if row.time == following.time:
            first, second = sorted((row.where, following.where), key=_line)
            raise InputError(
                f"{second}: the time stamp {row.time:.6f} of line {_line(first)} again, expected each once"
            )


def _line(where: str) -> int:
    return int(where.rpartition(" ")[2])


def _lines(path: Path) -> list[str]:
    with open_binary(path, "a text file") as file:
        content = file.read(LARGEST_LIST + 1)
    if len(content) > LARGEST_LIST:
        raise InputError(f"{path}: has more than {LARGEST_LIST // 2**20} MiB, expected a list of time stamps")
    try:
        return content.decode("utf-8-sig").split("\n")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is not text ({error.reason}), expected a list of time stamps") from error
