"""A file of results: one JSON line per trial, each on disk before its trial counts as done."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, TypeAlias

from bidnerf_core.evaluation.json_lines import JsonLinesFile, LineFormat, as_line
from bidnerf_core.evaluation.trial import Trial, TrialResult
from bidnerf_core.io.json import from_plain, to_plain

Key: TypeAlias = str
"""The identity of a trial, independent of where its folders are."""

RESULT_LINES = LineFormat(b'{"T_world_camera": ', "lines as 'bidnerf evaluate' writes")


def key_of(trial: Trial) -> Key:
    """Return a key that is equal for two trials if and only if they are the same trial, on any machine."""
    return json.dumps(to_plain(trial.portable), sort_keys=True)


def result_line(result: TrialResult) -> bytes:
    """Return the line of a results file that holds ``result``."""
    return as_line(to_plain(result))


def read_results(paths: Iterable[Path]) -> list[TrialResult]:
    """Return the results of all files in order; a result that several files hold is returned once.

    An incomplete last line is ignored. Raises ``InputError`` for a file that cannot be read or holds something else.
    """
    found: dict[Any, TrialResult] = {}
    for path in paths:
        for where, plain in RESULT_LINES.read(path):
            result = from_plain(TrialResult, plain, where)
            found.setdefault((key_of(result.trial), result.weights, result.inputs), result)
    return list(found.values())


class ResultsFile:
    """A file to which results are appended, locked by the process that has it open. Use it as a context manager."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.results: dict[Key, TrialResult] = {}
        self._file = JsonLinesFile(path, RESULT_LINES)

    def __enter__(self) -> ResultsFile:
        try:
            for where, plain in self._file.open():
                result = from_plain(TrialResult, plain, where)
                self.results.setdefault(key_of(result.trial), result)
            self._file.repair()
        except BaseException:
            self._file.close()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()

    def add(self, result: TrialResult) -> None:
        """Append a result, which is on disk when this returns. Raises ``InputError`` where the file was removed."""
        self._file.append(to_plain(result))
        self.results[key_of(result.trial)] = result

    def put_in_order(self, trials: Sequence[Trial]) -> None:
        """Move the results of ``trials`` to the end of the file, in their order, in one atomic step."""
        self._file.check_there()
        wanted = [key_of(trial) for trial in trials]
        asked = set(wanted)
        order = [key for key in self.results if key not in asked] + [k for k in wanted if k in self.results]
        if order != list(self.results):
            self._file.replace(to_plain(self.results[key]) for key in order)
            self.results = {key: self.results[key] for key in order}
