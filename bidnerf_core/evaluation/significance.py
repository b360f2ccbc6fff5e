"""Tests of whether two groups of trials differ in success or in speed."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

from bidnerf_core.evaluation.groups import Group
from bidnerf_core.evaluation.summary import NEVER, applies, median, steps_of


@dataclass(frozen=True)
class PairTest:
    """Tests of whether two groups of trials in the same situation differ, by one criterion. All p values are two-sided."""

    first: str
    second: str
    trials: tuple[int, int]
    successes: tuple[int, int]
    rates_p: float  # of equal success rates, Fisher's exact test
    median_steps: tuple[float | None, float | None]
    steps_u: float | None  # Mann-Whitney U of the first group, over the trials that succeeded
    steps_p: float | None  # of equal steps to success
    all_p: float  # of equal speed over all trials, where a failure is slower than every success


def pairwise_tests(groups: Sequence[Group], criterion: str) -> list[PairTest]:
    """Return the tests of every pair of groups that share a situation and to which the criterion applies."""
    fitting = [group for group in groups if applies(criterion, group.results)]
    pairs = itertools.combinations(fitting, 2)
    return [compare_pair(a, b, criterion) for a, b in pairs if a.situation == b.situation]


def compare_pair(first: Group, second: Group, criterion: str) -> PairTest:
    """Test whether two groups differ in success rate or in steps to success, by one criterion."""
    from scipy.stats import fisher_exact, mannwhitneyu  # here: the import takes a second

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
    """Return the p value over all trials. All failures tie; it is 1 where all trials tie."""
    from scipy.stats import mannwhitneyu

    if len({*first, *second}) == 1:
        return 1.0
    largest = 1 + max((s for s in (*first, *second) if s < NEVER), default=0)
    ranks = [[min(s, largest) for s in row] for row in (first, second)]  # only the order matters
    return float(mannwhitneyu(*ranks, alternative="two-sided", method="asymptotic").pvalue)
