"""Statistics of trials: success rates with intervals, steps and time to success, errors and cost, and
significance tests.
"""

from __future__ import annotations

import itertools
import math
import statistics
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from bidnerf_core.evaluation.groups import Group
from bidnerf_core.evaluation.trial import TrialResult
from bidnerf_core.geometry import LengthUnit
from bidnerf_core.results import CRITERIA, Rate, Reduced, steps_to_success, success_rate_by_frame

NEVER = math.inf
"""Steps to success of a trial that did not succeed."""

RELATIVE, ABSOLUTE = "10%", "5deg 0.05"
"""The criterion used where only one is shown: with a start, and without."""


@dataclass(frozen=True)
class Success:
    """The rate at which trials met a criterion, and the median steps and time of those that met it."""

    rate: Rate
    steps: float | None
    milliseconds: float | None


@dataclass(frozen=True)
class Summary:
    """Statistics of a group of trials. A median is None if the middle value is unknown."""

    trials: int
    frames: int  # number of distinct ones; this, not the number of trials, limits the precision of the rates
    unit: LengthUnit  # of the errors
    criteria: dict[str, Success | None]  # by name; None if a criterion does not apply
    translation: float | None  # median of the final errors
    rotation_deg: float | None  # median of the final errors
    steps: float  # median
    seconds: float  # median
    milliseconds_per_step: float  # median
    peak_memory_bytes: int  # largest
    converged: int
    converged_but_wrong: int  # converged, and not within 5 degrees and 0.05
    right_but_not_converged: int


def frame_of(result: TrialResult) -> tuple[str, str, tuple[str, ...]]:
    """Return the identity of a trial's images: trials of the same images are not independent."""
    return result.trial.data, result.trial.split, result.trial.frames


def unit_of(results: Sequence[TrialResult]) -> LengthUnit:
    """Return the unit of the errors of some trials: metres if that holds for all of them."""
    return "metres" if results and all(result.unit == "metres" for result in results) else "units"


def applies(criterion: str, results: Sequence[TrialResult]) -> bool:
    """Return whether a criterion applies to every trial: a relative criterion needs a start."""
    needs_start = isinstance(CRITERIA[criterion], Reduced)
    return not needs_start or all(result.start_error is not None for result in results)


def usual_criterion(results: Sequence[TrialResult]) -> str:
    """Return the name of the criterion to use where only one is shown."""
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
    """Return whether the final pose is within 5 degrees and 0.05 (in the unit of the map) of the true one."""
    return result.error is not None and steps_of([result], ABSOLUTE)[0] < NEVER


def summarize(results: Sequence[TrialResult]) -> Summary:
    """Return the statistics of at least one trial."""
    pairs = [(result.converged, succeeded(result)) for result in results]
    errors = [result.error for result in results]
    return Summary(
        trials=len(results),
        frames=len({frame_of(result) for result in results}),
        unit=unit_of(results),
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
    """Return how often and how soon trials met a criterion; None if it does not apply to them."""
    if not applies(criterion, results):
        return None
    reached = [s for s in steps_of(results, criterion) if s < NEVER]
    times = [1000 * seconds for seconds in seconds_to_success(results, criterion)]
    met = [s < NEVER for s in steps_of(results, criterion)]
    rate = success_rate_by_frame(met, [frame_of(result) for result in results])
    return Success(rate, median(reached), median(times))


def median(values: Iterable[float | None]) -> float | None:
    """Return the median (of an even number, the mean of the two middle values); an unknown value counts as
    infinite.

    Returns None if there is no value, or if a middle value is unknown.
    """
    known = [math.inf if value is None else float(value) for value in values]
    middle = statistics.median(known) if known else math.inf
    return middle if math.isfinite(middle) else None


def milliseconds_per_step(result: TrialResult) -> float:
    """Return the mean time per step of a trial."""
    return 1000 * result.seconds / max(1, result.steps)


@dataclass(frozen=True)
class PairTest:
    """Tests of whether two groups of trials in the same situation differ, by one criterion. All p values are
    two-sided.
    """

    first: str
    second: str
    trials: tuple[int, int]
    successes: tuple[int, int]
    rates_p: float  # of equal success rates, Fisher's exact test
    median_steps: tuple[float | None, float | None]
    steps_u: float | None  # Mann-Whitney U of the first group, over the trials that succeeded
    steps_p: float | None  # of equal steps to success
    all_p: float  # of equal speed over all trials, where a failure is slower than any success


def pairwise_tests(groups: Sequence[Group], criterion: str) -> list[PairTest]:
    """Return the tests of every pair of groups that share a situation and to which the criterion applies."""
    fitting = [group for group in groups if applies(criterion, group.results)]
    pairs = itertools.combinations(fitting, 2)
    return [compare_pair(a, b, criterion) for a, b in pairs if a.situation == b.situation]


def compare_pair(first: Group, second: Group, criterion: str) -> PairTest:
    """Test whether two groups differ in success rate or in steps to success, by one criterion."""
    from scipy.stats import fisher_exact, mannwhitneyu  # imported here: it takes a second

    steps = [steps_of(group.results, criterion) for group in (first, second)]
    reached = [[s for s in row if s < NEVER] for row in steps]
    tables = [[len(good), len(row) - len(good)] for good, row in zip(reached, steps, strict=True)]
    test = mannwhitneyu(*reached, alternative="two-sided") if all(reached) else None
    return PairTest(
        first=first.label,
        second=second.label,
        trials=(len(steps[0]), len(steps[1])),
        successes=(len(reached[0]), len(reached[1])),
        rates_p=float(fisher_exact(tables).pvalue),
        median_steps=(median(reached[0]), median(reached[1])),
        steps_u=None if test is None else float(test.statistic),
        steps_p=None if test is None else float(test.pvalue),
        all_p=_all_p(*steps),
    )


def _all_p(first: list[float], second: list[float]) -> float:
    """Return the p value over all trials. All failures tie; it is 1 if all trials tie."""
    from scipy.stats import mannwhitneyu

    if len({*first, *second}) == 1:
        return 1.0
    largest = 1 + max((s for s in (*first, *second) if s < NEVER), default=0)
    ranks = [[min(s, largest) for s in row] for row in (first, second)]  # only the order matters
    return float(mannwhitneyu(*ranks, alternative="two-sided", method="asymptotic").pvalue)
