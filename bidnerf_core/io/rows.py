"""Text files of rows: words and numbers separated by white space; ``#`` begins a comment if the format has comments."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from bidnerf_core.errors import InputError
from bidnerf_core.io.files import library_errors, read_file

LARGEST_ROWS = 256 * 2**20
"""Default limit on the size of a file (bytes), about that of a trajectory over a whole day at 100 Hz."""


@dataclass(frozen=True, slots=True)
class Row:
    """A line of a text file, stripped of leading and trailing white space."""

    path: Path
    line: int  # counted from 1
    text: str
    columns: str  # expected content, which ends each message: "timestamp tx ty tz"

    @property
    def where(self) -> str:
        """The file and the line number, used as the beginning of error messages."""
        return f"{self.path}: line {self.line}"

    @property
    def words(self) -> list[str]:
        return self.text.split()

    def error(self, finding: str) -> InputError:
        """Return the error for this row; ``finding`` begins with a space or a colon."""
        return InputError(f"line {self.line}{finding}", where=self.path, expected=self.columns)

    def numbers(self, words: Sequence[str] | None = None, count: int | None = None) -> list[float]:
        """Parse the ``words`` (by default the whole row) as finite numbers, exactly ``count`` of them if given.

        Raises ``InputError`` for anything else.
        """
        words = self.words if words is None else words
        if count is not None and len(words) != count:
            raise self.error(f" has {len(words)} entries")
        found = self.plain_numbers(words)
        if not all(map(math.isfinite, found)):
            raise self.error(f": {self.text[:60]!r} is not finite")
        return found

    def plain_numbers(self, words: Sequence[str]) -> list[float]:
        """Parse the ``words`` as numbers, which may be NaN or infinite. Raises ``InputError`` for other words."""
        try:
            return [float(word) for word in words]
        except ValueError as error:
            raise self.error(f": {error}") from error

    def integer(self, word: str) -> int:
        """Parse a word as an integer of at most 64 bits. Raises ``InputError`` for anything else."""
        try:
            found = int(word)
        except ValueError as error:
            raise self.error(f": {error}") from error
        if not abs(found) < 2**63:
            raise self.error(f": {word[:60]} has more than 64 bits")
        return found


def read_rows(path: Path, expected: str, columns: str, most: int = LARGEST_ROWS) -> list[Row]:
    """Read the non-empty rows of a file, without comments. Raises ``InputError`` as ``read_file`` does, and for non-text files.

    ``expected`` briefly describes the file, ``columns`` a row.
    """
    return parse_rows(read_file(path, expected, most), path, expected, columns)


def parse_rows(content: bytes, path: Path, expected: str, columns: str) -> list[Row]:
    """Parse rows from the content of the file ``path``, as ``read_rows`` does."""
    with library_errors(path, "is not text", expected, UnicodeDecodeError):
        lines = content.decode("utf-8-sig").split("\n")
    rows = (Row(path, number, line.partition("#")[0].strip(), columns) for number, line in enumerate(lines, start=1))
    return [row for row in rows if row.text]


def read_lines(path: Path, expected: str, columns: str, most: int = LARGEST_ROWS) -> list[Row]:
    """Read all lines of a text file, including empty lines and comments; bytes that are not UTF-8 are replaced.

    Raises ``InputError`` as ``read_file`` does.
    """
    lines = read_file(path, expected, most).decode("utf-8-sig", "replace").split("\n")
    return [Row(path, number, line.strip(), columns) for number, line in enumerate(lines, start=1)]
