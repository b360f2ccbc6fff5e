"""A file of results: one JSON line a trial, safe against a kill at any moment.

A line is written, and on the disk, before its trial counts as done. What a kill left half-written at the end is cut off
when the file is next opened; anything else that is not a result is an error that names the line, never thrown away.
"""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from types import TracebackType
from typing import IO, TypeAlias

from bidnerf_core.errors import InputError
from bidnerf_core.evaluation.trials import Trial, TrialResult
from bidnerf_core.serialization import from_plain, to_plain
from bidnerf_core.storage import write_file

Key: TypeAlias = str
"""What tells trials apart, wherever their folders are."""

OPENING = b'{"T_world_camera": '
"""How every line begins: of a file that is something else, nothing is ever cut off."""


def key_of(trial: Trial) -> Key:
    return json.dumps(to_plain(trial.portable), sort_keys=True)


def as_line(result: TrialResult) -> bytes:
    return json.dumps(to_plain(result), allow_nan=False).encode() + b"\n"


def read_results(paths: Iterable[Path]) -> list[TrialResult]:
    """Of all files, in order; a trial that is in several is taken once. A half-written last line is passed over."""
    found: dict[tuple[Key, str], TrialResult] = {}
    for path in paths:
        for result in _parsed(path, _read(path))[0]:
            found.setdefault((key_of(result.trial), result.weights), result)
    return list(found.values())


class ResultsFile:
    """Results that grow. Use as a context; another process that opens the same file meanwhile is refused."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.results: dict[Key, TrialResult] = {}
        self._file: IO[bytes] | None = None

    def __enter__(self) -> ResultsFile:
        self._file = self._locked()
        try:
            content = self._file.read()
            found, whole = _parsed(self.path, content)
            for result in found:
                self.results.setdefault(key_of(result.trial), result)
            self._cut(whole, content)
        except BaseException:
            self._file.close()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._file is not None:
            self._file.close()
            self._file = None

    def add(self, result: TrialResult) -> None:
        """On the disk when this returns."""
        if self._file is None:
            raise RuntimeError("the file of results is not open")
        self._file.write(as_line(result))
        self._file.flush()
        os.fsync(self._file.fileno())
        self.results[key_of(result.trial)] = result

    def put_in_order(self, trials: Sequence[Trial]) -> None:
        """These trials in this order, behind whatever else the file holds; all at once or not at all."""
        wanted = [key_of(trial) for trial in trials]
        asked = set(wanted)
        order = [key for key in self.results if key not in asked] + [k for k in wanted if k in self.results]
        if order != list(self.results):
            write_file(self.path, b"".join(as_line(self.results[key]) for key in order))
            self.results = {key: self.results[key] for key in order}
            self.__exit__(None, None, None)  # what was open is the file of before
            self._file = self._locked()

    def _locked(self) -> IO[bytes]:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        try:
            file = self.path.open("a+b")
        except OSError as error:
            raise InputError(f"{self.path}: cannot be written ({error.strerror}), expected a file") from error
        with contextlib.suppress(ImportError):  # Windows has no such locks
            import fcntl

            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as error:
                file.close()
                raise InputError(f"{self.path}: another process is writing it; name another --out") from error
        file.seek(0)
        return file

    def _cut(self, whole: int, content: bytes) -> None:
        """Keep the first ``whole`` bytes, and end them with a line's end."""
        assert self._file is not None
        if whole < len(content):
            self._file.truncate(whole)
        if whole and content[whole - 1 : whole] != b"\n":
            self._file.write(b"\n")
        self._file.flush()


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror}), expected lines as 'bidnerf evaluate' writes"
        ) from error


def _parsed(path: Path, content: bytes) -> tuple[list[TrialResult], int]:
    """The results, and how many bytes from the beginning are of use."""
    lines, found, place = content.split(b"\n"), [], 0
    for number, line in enumerate(lines, start=1):
        where = f"{path}: line {number}"
        try:
            plain = json.loads(line) if line.strip() else None
        except (ValueError, RecursionError) as error:
            if number == len(lines) and (line.startswith(OPENING) or OPENING.startswith(line)):
                break
            raise InputError(f"{where}: not JSON, expected lines as 'bidnerf evaluate' writes") from error
        if plain is not None:
            found.append(from_plain(TrialResult, plain, where))
        place += len(line) + (number < len(lines))
    return found, place
