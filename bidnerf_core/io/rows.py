"""Text files of rows: words and numbers, separated by blanks; ``#`` begins a comment where the format has comments."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from bidnerf_core.errors import InputError
from bidnerf_core.io.files import read_file

LARGEST_ROWS = 256 * 2**20
"""Bytes. A trajectory over a whole day at 100 Hz is about as large."""
SHOWN = 60
"""Characters of a row that a message shows."""


@dataclass(frozen=True)
class Row:
    """A line of a file, without the blanks around it."""

    path: Path
    line: int  # counted from 1
    text: str
    columns: str  # what it should hold, the end of each message: "timestamp tx ty tz"

    @property
    def where(self) -> str:
        """The file and the line, as messages begin."""
        return f"{self.path}: line {self.line}"

    @property
    def words(self) -> list[str]:
        return self.text.split()

    def error(self, finding: str) -> InputError:
        """Return the error about this row; a ``finding`` begins with a blank or a colon."""
        return InputError(f"{self.where}{finding}, expected {self.columns}")

    def numbers(self, words: Sequence[str] | None = None, count: int | None = None) -> list[float]:
        """Return the ``words`` (all of the row if None) as finite numbers, which must be ``count`` if that is given.

        Raises ``InputError`` for anything else.
        """
        words = self.words if words is None else words
        if count is not None and len(words) != count:
            raise self.error(f" has {len(words)} entries")
        found = self.plain_numbers(words)
        if not all(map(math.isfinite, found)):
            raise self.error(f": {self.text[:SHOWN]!r} is not finite")
        return found

    def plain_numbers(self, words: Sequence[str]) -> list[float]:
        """Return the ``words`` as numbers, which may be NaN or infinite. Raises ``InputError`` for other words."""
        try:
            return [float(word) for word in words]
        except ValueError as error:
            raise self.error(f": {error}") from error

    def integer(self, word: str) -> int:
        """Return a word as a whole number of at most 64 bits. Raises ``InputError`` for anything else."""
        try:
            found = int(word)
        except ValueError as error:
            raise self.error(f": {error}") from error
        if not abs(found) < 2**63:
            raise self.error(f": {word[:SHOWN]} has more than 64 bits")
        return found


def read_rows(path: Path, expected: str, columns: str, most: int = LARGEST_ROWS) -> list[Row]:
    """Return the rows of a file that are more than a comment. Raises ``InputError`` as ``read_file``, and for what is no text.

    ``expected`` describes in a few words what the file should be, ``columns`` a row.
    """
    return parse_rows(read_file(path, expected, most), path, expected, columns)


def parse_rows(content: bytes, path: Path, expected: str, columns: str) -> list[Row]:
    """Return the rows of the content of the file ``path``, as ``read_rows`` does."""
    try:
        lines = content.decode("utf-8-sig").split("\n")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is not text ({error.reason}), expected {expected}") from error
    rows = (
        Row(path, number, line.partition("#")[0].strip(), columns)
        for number, line in enumerate(lines, start=1)
    )
    return [row for row in rows if row.text]


def read_lines(path: Path, expected: str, columns: str, most: int = LARGEST_ROWS) -> list[Row]:
    """Return all lines of a file, empty ones and comments included, of text in any encoding. Raises ``InputError`` as ``read_file``."""
    lines = read_file(path, expected, most).decode("utf-8-sig", "replace").split("\n")
    return [Row(path, number, line.strip(), columns) for number, line in enumerate(lines, start=1)]
