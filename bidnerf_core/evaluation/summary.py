"""Statistics of trials: success rates with intervals, steps and time to success, errors and cost."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from bidnerf_core.evaluation.trial import TrialResult
from bidnerf_core.results.errors import CRITERIA, Rate, Reduced, steps_to_success, success_rate

NEVER = math.inf
"""Steps to success of a trial that did not succeed."""

RELATIVE, ABSOLUTE = "10%", "5deg 0.05"
"""The criterion shown where there is room for only one: with a start, and without."""


@dataclass(frozen=True)
class Success:
    """The rate at which trials met a criterion, and the median steps and time of those that met it."""

    rate: Rate
    steps: float | None
    milliseconds: float | None


@dataclass(frozen=True)
class Summary:
    """Statistics of one group of trials. A median is None where the middle value is unknown."""

    trials: int
    criteria: dict[str, Success | None]  # by name; None where a criterion does not apply
    translation: float | None  # metres, median of the final errors
    rotation_deg: float | None  # median of the final errors
    steps: float  # median
    seconds: float  # median
    milliseconds_per_step: float  # median
    peak_memory_bytes: int  # largest
    converged: int
    converged_but_wrong: int  # converged, and not within 5 degrees and 0.05 m
    right_but_not_converged: int


def applies(criterion: str, results: Sequence[TrialResult]) -> bool:
    """Return whether a criterion applies to every trial: a share of the start's error needs a start."""
    needs_start = isinstance(CRITERIA[criterion], Reduced)
    return not needs_start or all(result.start_error is not None for result in results)


def usual_criterion(results: Sequence[TrialResult]) -> str:
    """Return the name of the criterion to show where there is room for only one."""
    return RELATIVE if applies(RELATIVE, results) else ABSOLUTE


def steps_of(results: Sequence[TrialResult], criterion: str) -> list[float]:
    """Return the steps to success of each trial, ``NEVER`` for those without success."""
    found = (steps_to_success(result.errors.as_error(), CRITERIA[criterion]) for result in results)
    return [NEVER if steps is None else float(steps) for steps in found]


def seconds_to_success(results: Sequence[TrialResult], criterion: str) -> list[float]:
    """Return the sorted times to success of the trials that met the criterion."""
    steps = zip(steps_of(results, criterion), results, strict=True)
    return sorted(s * milliseconds_per_step(r) / 1000 for s, r in steps if s < NEVER)


def succeeded(result: TrialResult) -> bool:
    """Return whether the final pose is within 5 degrees and 0.05 m of the true one."""
    return result.error is not None and steps_of([result], ABSOLUTE)[0] < NEVER


def summarize(results: Sequence[TrialResult]) -> Summary:
    """Return the statistics of at least one trial."""
    pairs = [(result.converged, succeeded(result)) for result in results]
    errors = [result.error for result in results]
    return Summary(
        trials=len(results),
        criteria={name: success_of(results, name) for name in CRITERIA},
        translation=median(e.translation if e else None for e in errors),
        rotation_deg=median(e.rotation_deg if e else None for e in errors),
        steps=statistics.median(r.steps for r in results),
        seconds=statistics.median(r.seconds for r in results),
        milliseconds_per_step=statistics.median(map(milliseconds_per_step, results)),
        peak_memory_bytes=max(r.peak_memory_bytes for r in results),
        converged=sum(said for said, _ in pairs),
        converged_but_wrong=sum(said and not right for said, right in pairs),
        right_but_not_converged=sum(right and not said for said, right in pairs),
    )


def success_of(results: Sequence[TrialResult], criterion: str) -> Success | None:
    """Return how often and how soon trials met a criterion; None where it does not apply to them."""
    if not applies(criterion, results):
        return None
    reached = [s for s in steps_of(results, criterion) if s < NEVER]
    times = [1000 * seconds for seconds in seconds_to_success(results, criterion)]
    return Success(success_rate(len(reached), len(results)), median(reached), median(times))


def median(values: Iterable[float | None]) -> float | None:
    """Return the median (of an even number, the mean of the two middle values); an unknown value counts as infinite.

    Returns None where there is no value, or where a middle value is unknown.
    """
    known = [math.inf if value is None else float(value) for value in values]
    middle = statistics.median(known) if known else math.inf
    return middle if math.isfinite(middle) else None


def milliseconds_per_step(result: TrialResult) -> float:
    """Return the mean time of a step of one trial."""
    return 1000 * result.seconds / max(1, result.steps)
