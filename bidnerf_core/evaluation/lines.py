"""Append-only files of one JSON object per line, which stay valid if the process is killed at any moment.

A line is on disk before its work counts as done. An incomplete last line, left by a kill, is removed when the file is next
opened. Anything else that is not JSON raises an error that names the line, and is never deleted.
"""

from __future__ import annotations

import json
import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, BinaryIO, ClassVar, Generic, Self, TypeVar

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

Value = TypeVar("Value")


class LinesFile(ABC, Generic[Value]):
    """A key-value file with one entry per line, locked by the process that has it open. Use it as a context manager.

    Without a path, the values are kept in memory only.
    """

    opening: ClassVar[bytes]
    """The beginning of each line. An incomplete last line is dropped only if it begins so: no unrelated file is truncated."""
    expected: ClassVar[str]
    """A description of the content, for messages."""

    def __init__(self, path: Path | None) -> None:
        self.path = path
        self.values: dict[str, Value] = {}
        self._file: BinaryIO | None = None

    @classmethod
    @abstractmethod
    def parsed(cls, plain: Any, where: str) -> tuple[str, Value]:
        """Return the key and the value of a line. Raises ``InputError``."""

    @abstractmethod
    def plain(self, key: str, value: Value) -> Any:
        """Return a line as a JSON value."""

    @classmethod
    def read(cls, path: Path) -> list[tuple[str, Value]]:
        """Return the key and value of each complete line. Raises ``InputError`` if the file cannot be read."""
        return cls.parse(path, read_file(path, cls.expected, LARGEST_LINES))

    @classmethod
    def parse(cls, path: Path, content: bytes) -> list[tuple[str, Value]]:
        """Return the key and value of each complete line of the content of a file. Raises ``InputError``."""
        return [cls.parsed(plain, where) for where, plain in cls._lines(path, content)[0]]

    @classmethod
    def _lines(cls, path: Path, content: bytes) -> tuple[list[tuple[str, Any]], int]:
        """Return the location (for messages) and the object of each line, and the number of bytes in complete lines."""
        lines, found, length = content.split(b"\n"), [], 0
        for number, line in enumerate(lines, start=1):
            where = f"{path}: line {number}"
            try:
                plain = parse_json(line, where, cls.expected) if line.strip() else None
            except InputError:
                if number == len(lines) and (line.startswith(cls.opening) or cls.opening.startswith(line)):
                    break
                raise
            if plain is not None:
                found.append((where, plain))
            length += len(line) + (number < len(lines))
        return found, length

    def __enter__(self) -> Self:
        if self.path is None:
            return self
        file = self._open()
        try:
            content = read_open_file(file, self.path, self.expected, LARGEST_LINES)
            lines, whole = self._lines(self.path, content)
            for where, plain in lines:
                key, value = self.parsed(plain, where)
                self.values.setdefault(key, value)
            if whole < len(content):
                file.truncate(whole)
            if whole and content[whole - 1 : whole] != b"\n":
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

    def append(self, key: str, value: Value) -> None:
        """Add a value, which is on disk when this returns. Raises ``InputError`` if the file was removed."""
        if self.path is not None:
            file = self._unmoved()
            file.write(as_line(self.plain(key, value)))
            file.flush()
            os.fsync(file.fileno())
        self.values[key] = value

    def reorder(self, last: Iterable[str]) -> None:
        """Move the values of some keys to the end of the file, in their order, in one atomic step."""
        wanted = [key for key in last if key in self.values]
        order = [key for key in self.values if key not in set(wanted)] + wanted
        if self.path is not None:
            self._unmoved()
            if order != list(self.values):
                write_file(self.path, b"".join(as_line(self.plain(key, self.values[key])) for key in order))
                self.__exit__()  # the open file is the one that was replaced
                self._open()
        self.values = {key: self.values[key] for key in order}

    def _unmoved(self) -> BinaryIO:
        """Return the open file. Raises ``InputError`` if the path no longer names it: lines would be lost unnoticed."""
        if self._file is None or self.path is None:
            raise RuntimeError(f"{self.path} is not open")
        try:
            same = os.path.samestat(os.fstat(self._file.fileno()), self.path.stat())
        except FileNotFoundError:
            same = False
        if not same:
            raise InputError(
                "was removed or replaced while it was being written, so its content is lost; start again, or"
                " move the file back",
                where=self.path,
            )
        return self._file

    def _open(self) -> BinaryIO:
        """Open, create if needed, and lock the file."""
        assert self.path is not None
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            if self.path.exists():
                open_binary(self.path, self.expected).close()  # not a pipe, which would wait for a reader
            self._file = self.path.open("a+b")
        except OSError as error:
            raise InputError(
                f"cannot be written ({error.strerror})", where=self.path, expected="a file"
            ) from error
        if not take_lock(self._file.fileno()):
            self.__exit__()
            raise FileInUse("another process is writing to it; name another --out", where=self.path)
        self._file.seek(0)
        return self._file


class RowStore(LinesFile[Any]):
    """A file of results by key, which lets an interrupted script resume.

    Each row is computed once and stored as a line ``{"key": KEY, "row": ROW}``.
    """

    opening, expected = b'{"key": ', "lines in the format of benchmark rows"

    @classmethod
    def parsed(cls, plain: Any, where: str) -> tuple[str, Any]:
        if not isinstance(plain, dict) or plain.keys() != {"key", "row"}:
            raise InputError("no key and row", where=where, expected=cls.expected)
        return plain["key"], plain["row"]

    def plain(self, key: str, value: Any) -> Any:
        return {"key": key, "row": value}

    def __contains__(self, key: list[Any]) -> bool:
        return json.dumps(key) in self.values

    def get(self, key: list[Any], make: Callable[[], Any]) -> Any:
        """Return the row of ``key``; if the file does not hold it, compute it with ``make`` and store it."""
        text = json.dumps(key)
        if text not in self.values:
            self.append(text, make())
        return self.values[text]


def as_line(plain: Any) -> bytes:
    """Return ``plain`` as one line of strict JSON."""
    return json.dumps(plain, allow_nan=False).encode() + b"\n"
