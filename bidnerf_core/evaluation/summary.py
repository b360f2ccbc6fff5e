"""What a group of results comes to: rates with intervals, steps, errors; and whether two groups differ."""

from __future__ import annotations

import itertools
import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass

from scipy.stats import fisher_exact, mannwhitneyu

from bidnerf_core.evaluation.errors import CRITERIA, Rate, Reduced, steps_to_success, success_rate
from bidnerf_core.evaluation.groups import Group
from bidnerf_core.evaluation.trials import TrialResult

NEVER = math.inf
"""Steps to success of a trial that did not succeed."""


@dataclass(frozen=True)
class Judged:
    """A group by one criterion."""

    rate: Rate
    median_steps: float | None  # to success, of the trials that had it


@dataclass(frozen=True)
class Summary:
    """Of one group."""

    trials: int
    criteria: dict[
        str, Judged | None
    ]  # by name; none where a criterion does not apply: no start, no share of it
    translation: float  # metres; median over trials at the end, as is ...
    rotation_deg: float
    seconds: float
    milliseconds_per_step: float
    peak_memory_bytes: int  # the most
    converged_but_wrong: int  # said converged, and is over 5 degrees or 0.05 m
    right_but_not_converged: int


@dataclass(frozen=True)
class Comparison:
    """Of two groups of one situation by one criterion."""

    first: str
    second: str
    trials: tuple[int, int]
    successes: tuple[int, int]
    rates_p: float  # Fisher's exact test, two-sided: do they succeed equally often?
    median_steps: tuple[float | None, float | None]
    steps_u: (
        float | None
    )  # Mann-Whitney U of the first, over the trials that succeeded: are they equally fast?
    steps_p: float | None  # two-sided
    all_p: float  # the same test over all trials, a failure being slower than every success


def applies(criterion: str, results: Sequence[TrialResult]) -> bool:
    """A share of the start's error needs a start."""
    needs_start = isinstance(CRITERIA[criterion], Reduced)
    return not needs_start or all(result.start_error is not None for result in results)


def steps_of(results: Sequence[TrialResult], criterion: str) -> list[float]:
    """Steps to success of each trial, ``NEVER`` where there was none."""
    found = (steps_to_success(result.errors.as_error(), CRITERIA[criterion]) for result in results)
    return [NEVER if steps is None else float(steps) for steps in found]


def summarize(results: Sequence[TrialResult]) -> Summary:
    said, right = (
        [result.converged for result in results],
        [s < NEVER for s in steps_of(results, "5deg 0.05")],
    )
    pairs = list(zip(said, right, strict=True))
    return Summary(
        trials=len(results),
        criteria={name: _judged(results, name) for name in CRITERIA},
        translation=_median([r.error.translation if r.error else math.inf for r in results]),
        rotation_deg=_median([r.error.rotation_deg if r.error else math.inf for r in results]),
        seconds=_median([r.seconds for r in results]),
        milliseconds_per_step=_median([1000 * r.seconds / max(1, r.steps) for r in results]),
        peak_memory_bytes=max(r.peak_memory_bytes for r in results),
        converged_but_wrong=sum(s and not r for s, r in pairs),
        right_but_not_converged=sum(r and not s for s, r in pairs),
    )


def comparisons(groups: Sequence[Group], criterion: str) -> list[Comparison]:
    """Every pair of groups of one situation that the criterion applies to."""
    fitting = [group for group in groups if applies(criterion, group.results)]
    return [
        compare(a, b, criterion) for a, b in itertools.combinations(fitting, 2) if a.situation == b.situation
    ]


def compare(first: Group, second: Group, criterion: str) -> Comparison:
    steps = [steps_of(group.results, criterion) for group in (first, second)]
    reached = [[s for s in row if s < NEVER] for row in steps]
    tables = [[len(good), len(row) - len(good)] for good, row in zip(reached, steps, strict=True)]
    test = mannwhitneyu(*reached, alternative="two-sided") if all(reached) else None
    return Comparison(
        first=first.label,
        second=second.label,
        trials=(len(steps[0]), len(steps[1])),
        successes=(len(reached[0]), len(reached[1])),
        rates_p=float(fisher_exact(tables).pvalue),
        median_steps=(_median_or_none(reached[0]), _median_or_none(reached[1])),
        steps_u=None if test is None else float(test.statistic),
        steps_p=None if test is None else float(test.pvalue),
        all_p=_all_p(*steps),
    )


def _all_p(first: list[float], second: list[float]) -> float:
    """With ties, which failures are; where all are tied, nothing differs."""
    if len({*first, *second}) == 1:
        return 1.0
    largest = 1 + max((s for s in (*first, *second) if s < NEVER), default=0)
    ranks = [[min(s, largest) for s in row] for row in (first, second)]  # only the order counts
    return float(mannwhitneyu(*ranks, alternative="two-sided", method="asymptotic").pvalue)


def _judged(results: Sequence[TrialResult], criterion: str) -> Judged | None:
    if not applies(criterion, results):
        return None
    reached = [s for s in steps_of(results, criterion) if s < NEVER]
    return Judged(success_rate(len(reached), len(results)), _median_or_none(reached))


def _median(values: Sequence[float]) -> float:
    return float(statistics.median(values))


def _median_or_none(values: Sequence[float]) -> float | None:
    return _median(values) if values else None
