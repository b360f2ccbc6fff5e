"""Counts of right and silent answers of each peer, and of the frames that only one of two peers localizes."""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from scipy.stats import binomtest

from bidnerf_core.results.errors import CRITERIA, Within, success_rate

LIMITS = ("translation", "rotation_deg")
CRITERIA_REPORTED = ("5deg 0.05", "1deg 0.02")
RIGHT, STRICT = CRITERIA_REPORTED


def within(row: dict[str, Any], name: str) -> bool:
    """Return whether an answer meets a criterion; no answer meets none."""
    limits = CRITERIA[name]
    assert isinstance(limits, Within)
    return all(row[part] is not None and row[part] < getattr(limits, part) for part in LIMITS)


def summary(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return success with Wilson intervals, median errors (None if half have no answer), times and silent answers."""
    counts = {
        name: asdict(success_rate(sum(within(row, name) for row in rows), len(rows)))
        for name in CRITERIA_REPORTED
    }
    seconds = [row["cpu_seconds"] for row in rows]
    return {
        "n": len(rows),
        **counts,
        **{f"median_{part}": _median([row[part] for row in rows]) for part in LIMITS},
        "median_cpu_seconds": statistics.median(seconds),
        "slowest_cpu_seconds": max(seconds),
        **_judged(rows),
    }


def _median(values: Sequence[float | None]) -> float | None:
    found = statistics.median(math.inf if value is None else value for value in values)
    return found if math.isfinite(found) else None


def _judged(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return counts of the peer's own judgement against the truth; None for a peer that does not judge its answers."""
    names = ("accepted", "silent", "right_but_rejected")
    if any(row["accepted"] is None for row in rows):
        return dict.fromkeys(names)
    pairs = [(row["accepted"], within(row, RIGHT)) for row in rows]
    counts = (
        sum(said for said, _ in pairs),
        sum(said and not good for said, good in pairs),
        sum(good and not said for said, good in pairs),
    )
    return dict(zip(names, counts, strict=True))


def against(ours: Sequence[dict[str, Any]], theirs: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return how many frames both, one or neither localizes, with McNemar's exact p, and their time relative to ours."""
    pairs = list(zip(ours, theirs, strict=True))
    result: dict[str, Any] = {}
    for name in CRITERIA_REPORTED:
        found = [(within(a, name), within(b, name)) for a, b in pairs]
        only_ours, only_theirs = found.count((True, False)), found.count((False, True))
        apart = only_ours + only_theirs
        result[name] = {
            "both": found.count((True, True)),
            "only_auto": only_ours,
            "only_peer": only_theirs,
            "neither": found.count((False, False)),
            "p": float(binomtest(only_ours, apart).pvalue) if apart else 1.0,
        }
    ratio = statistics.median(b["cpu_seconds"] / a["cpu_seconds"] for a, b in pairs)
    return result | {"cpu_seconds_against_auto": ratio}


def line(found: dict[str, Any]) -> str:
    """Return a summary as a line of a table."""
    shift, turn = (
        "-" if found[f"median_{part}"] is None else f"{found[f'median_{part}']:.4f}" for part in LIMITS
    )
    silent = "-" if found["silent"] is None else f"{found['silent']} of {found['accepted']}"
    text = (
        f"n {found['n']:3} right {found[RIGHT]['successes']:3} strict {found[STRICT]['successes']:3}"
        f" median {shift} {turn} deg, silent {silent},"
        f" CPU {found['median_cpu_seconds']:.2f} s, slowest {found['slowest_cpu_seconds']:.2f} s"
    )
    if "paired" not in found:
        return text
    apart = "; ".join(
        f"{what} {found['paired'][name]['only_auto']}, {found['paired'][name]['only_peer']}"
        for what, name in (("right", RIGHT), ("strict", STRICT))
    )
    return f"{text} | only auto, only this: {apart}"
