"""Append-only files of one JSON object per line, which stay valid if the process is killed at any moment.

A line is on disk before its work counts as done. An incomplete last line, left by a kill, is removed when the
file is next opened. Anything else that is not JSON raises an error that names the line, and is never deleted.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO

from bidnerf_core.errors import InputError
from bidnerf_core.io import (
    FileInUse,
    open_binary,
    parse_json,
    read_file,
    read_open_file,
    take_lock,
    write_file,
)

LARGEST_LINES = 512 * 2**20
"""Bytes. A trial takes a few kilobytes, so this is enough for a hundred thousand trials."""


@dataclass(frozen=True)
class LineFormat:
    """The format of a JSON Lines file: the beginning of each line, and a description of the content for error messages.

    An incomplete last line is dropped only if it begins as expected; otherwise it is an error, so no
    unrelated file is truncated.
    """

    opening: bytes
    expected: str  # the end of the error message about any other line

    def parse(self, path: Path, content: bytes) -> tuple[list[tuple[str, Any]], int]:
        """Return the location (for messages) and the object of each line, and the number of bytes in complete lines."""
        lines, found, length = content.split(b"\n"), [], 0
        for number, line in enumerate(lines, start=1):
            where = f"{path}: line {number}"
            try:
                plain = parse_json(line, where, self.expected) if line.strip() else None
            except InputError:
                if number == len(lines) and (line.startswith(self.opening) or self.opening.startswith(line)):
                    break
                raise
            if plain is not None:
                found.append((where, plain))
            length += len(line) + (number < len(lines))
        return found, length

    def read(self, path: Path) -> list[tuple[str, Any]]:
        """Return the location and object of each complete line of ``path``. Raises ``InputError`` if it
        cannot be read.
        """
        return self.parse(path, read_file(path, self.expected, LARGEST_LINES))[0]


class JsonLinesFile:
    """A JSON Lines file, locked by the process that has it open, from ``open`` to ``close``."""

    def __init__(self, path: Path, kind: LineFormat) -> None:
        self.path, self._kind = path, kind
        self._file: BinaryIO | None = None

    def open(self) -> list[tuple[str, Any]]:
        """Create and lock the file; return the location and object of each line. Call ``repair`` before writing."""
        self._file = self._locked()
        try:
            content = read_open_file(self._file, self.path, self._kind.expected, LARGEST_LINES)
            found, whole = self._kind.parse(self.path, content)
        except BaseException:
            self.close()
            raise
        self._whole, self._content = whole, content
        return found

    def repair(self) -> None:
        """Remove an incomplete last line, and terminate the last complete one with a newline."""
        file, whole, content = self._opened(), self._whole, self._content
        if whole < len(content):
            file.truncate(whole)
        if whole and content[whole - 1 : whole] != b"\n":
            file.write(b"\n")
        file.flush()

    def close(self) -> None:
        if self._file is not None:
            self._file.close()
            self._file = None

    def append(self, plain: Any) -> None:
        """Write one line, which is on disk when this returns. Raises ``InputError`` if the file was removed."""
        file = self._opened()
        self.check_there()
        file.write(as_line(plain))
        file.flush()
        os.fsync(file.fileno())

    def replace(self, plain: Iterable[Any]) -> None:
        """Replace all lines atomically."""
        self.check_there()
        write_file(self.path, b"".join(map(as_line, plain)))
        self.close()  # the open file is the one that was replaced
        self._file = self._locked()

    def check_there(self) -> None:
        """Raise ``InputError`` if the path no longer names the open file, since lines would be lost unnoticed."""
        try:
            same = os.path.samestat(os.fstat(self._opened().fileno()), self.path.stat())
        except FileNotFoundError:
            same = False
        if not same:
            raise InputError(
                "was removed or replaced while it was being written, so its content is lost; start again, or"
                " move the file back",
                where=self.path,
            )

    def _opened(self) -> BinaryIO:
        if self._file is None:
            raise RuntimeError(f"{self.path} is not open")
        return self._file

    def _locked(self) -> BinaryIO:
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            if self.path.exists():
                open_binary(
                    self.path, self._kind.expected
                ).close()  # not a pipe, which would wait for a reader
            file = self.path.open("a+b")
        except OSError as error:
            raise InputError(
                f"cannot be written ({error.strerror})", where=self.path, expected="a file"
            ) from error
        if not take_lock(file.fileno()):
            file.close()
            raise FileInUse("another process is writing to it; name another --out", where=self.path)
        file.seek(0)
        return file


class RowStore:
    """A file of results by key, which lets an interrupted script resume. Use it as a context manager.

    Each row is computed once and stored as a line ``{"key": KEY, "row": ROW}``.
    """

    FORMAT = LineFormat(b'{"key": ', "lines in the format of benchmark rows")

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file = JsonLinesFile(path, self.FORMAT)
        self._rows: dict[str, Any] = {}

    def __enter__(self) -> RowStore:
        for where, plain in self._file.open():
            if not isinstance(plain, dict) or plain.keys() != {"key", "row"}:
                self._file.close()
                raise InputError("no key and row", where=where, expected=self.FORMAT.expected)
            self._rows[plain["key"]] = plain["row"]
        self._file.repair()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()

    def __contains__(self, key: list[Any]) -> bool:
        return json.dumps(key) in self._rows

    def get(self, key: list[Any], make: Callable[[], Any]) -> Any:
        """Return the row of ``key``; if the file does not hold it, compute it with ``make`` and store it."""
        text = json.dumps(key)
        if text not in self._rows:
            row = make()
            self._file.append({"key": text, "row": row})
            self._rows[text] = row
        return self._rows[text]


def as_line(plain: Any) -> bytes:
    """Return ``plain`` as one line of strict JSON."""
    return json.dumps(plain, allow_nan=False).encode() + b"\n"
