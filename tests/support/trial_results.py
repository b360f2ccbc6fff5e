"""Results of trials that nobody ran, for tests of what is made of results."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

from bidnerf.evaluation import InputDigests, ScalarPoseError, Trace, Trial, TrialResult


def trial_result(trial: Trial, distances: Sequence[float], angles: Sequence[float] = (), **changes: Any) -> TrialResult:
    """Return the result of a trial whose errors went like that, from the start on (metres, degrees); ``changes`` are
    other fields.
    """
    angles = tuple(angles) or (0.0,) * len(distances)
    start, end = (ScalarPoseError(distances[step], angles[step]) for step in (0, -1))
    made = TrialResult(
        None,
        True,
        len(distances) - 1,
        2.0,
        None,
        0.1,
        "fog",
        trial.method,
        end,
        trial.frame,
        trial.seed,
        start,
        Trace(tuple(distances), angles),
        "done",
        2**30,
        {},
        "weights-1",
        trial,
        "converged",
        InputDigests("0"),
        1.0,
    )
    return replace(made, **changes)


def timeless(rows: Iterable[TrialResult]) -> list[TrialResult]:
    """Return results without the values in which two runs differ."""
    return [replace(row, seconds=0.0, cpu_seconds=0.0, peak_memory_bytes=0) for row in rows]
