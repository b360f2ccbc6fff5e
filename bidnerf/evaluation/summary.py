"""Results grouped by situation (what was localized) and condition (what localized it), with statistics."""

from __future__ import annotations

import json
import math
import statistics
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

from bidnerf.evaluation.faults import NO_FAULT
from bidnerf.evaluation.trial import Trace, TrialResult
from bidnerf.results import CRITERIA, Rate, Reduced, common_unit, steps_to_success, success_rate_by_frame
from bidnerf_core.errors import amount
from bidnerf_core.geometry import LengthUnit

NEVER = math.inf
"""Steps to success of a trial that did not succeed."""

RELATIVE, ABSOLUTE = "10%", "5deg 0.05"
"""The criteria used where only one is shown: for trials with a start, and for trials without."""


# Groups.


@dataclass(frozen=True)
class Situation:
    """The map, images and starts that trials have in common. ``size`` is None if trials of all sizes are pooled."""

    map: str
    weights: str  # identifies the training run, see ``Map.training``
    data: str
    split: str
    protocol: str
    fault: str
    size: tuple[float, ...] | None

    @property
    def start(self) -> str:
        """The start in words, with the image faults if any."""
        size = ", all sizes" if self.size is None else f" {' : '.join(f'{number:g}' for number in self.size)}"
        words = f"{'no start' if self.protocol == 'none' else self.protocol}{size}".rstrip()
        return words if self.fault == NO_FAULT else f"{words}, {self.fault}"


@dataclass(frozen=True)
class ResultGroup:
    """The trials of one condition (a method with its settings, input and hardware) in one situation."""

    situation: Situation
    title: str  # of the situation in reports
    label: str  # of the condition in reports
    results: tuple[TrialResult, ...]

    @cached_property
    def summary(self) -> Summary:
        """Success rates with Wilson's 95 % intervals, errors and cost."""
        return summarize(self.results)


def group_results(results: Sequence[TrialResult]) -> list[ResultGroup]:
    """Group trial results by situation and condition, and add a pooled group for each condition tried at several sizes.

    Groups are sorted by map, data, protocol and fault in order of appearance, then by size, with the pooled sizes last.
    """
    conditions = [_condition(result) for result in results]
    labels = _labels(conditions)
    rows = dict[tuple[Situation, str], list[TrialResult]]()
    sizes = dict[tuple[Situation, str], set[Any]]()
    for result, condition in zip(results, conditions, strict=True):
        t, label = result.trial, labels[json.dumps(condition, sort_keys=True)]
        pooled = Situation(t.map, result.weights, t.data, t.images.split, t.protocol, t.fault, None)
        rows.setdefault((replace(pooled, size=t.size), label), []).append(result)
        rows.setdefault((pooled, label), []).append(result)
        sizes.setdefault((pooled, label), set()).add(t.size)
    order = {situation: number for number, (situation, _) in reversed(list(enumerate(sizes)))}
    keys = sorted(
        (key for key in rows if key not in sizes or len(sizes[key]) > 1),
        key=lambda key: (order[replace(key[0], size=None)], key[0].size is None, key[0].size or ()),
    )
    titles = situation_titles([situation for situation, _ in keys])
    return [
        ResultGroup(situation, titles[situation], label, tuple(rows[situation, label])) for situation, label in keys
    ]


def situations(groups: Sequence[ResultGroup]) -> list[Situation]:
    """Return the situations of ``groups``, each once, in order."""
    return list(dict.fromkeys(group.situation for group in groups))


def situation_titles(every: Sequence[Situation]) -> dict[Situation, str]:
    """Return a title for each situation: its start, preceded by the map and data unless all situations share these."""
    maps = {situation.map for situation in every}
    trainings = {(situation.map, situation.weights) for situation in every}
    datasets = {(situation.data, situation.split) for situation in every}
    titles = {}
    for s in every:
        retrained = sum(name == s.map for name, _ in trainings) > 1
        name = f"{s.map} ({s.weights.partition('.')[0]})" if retrained else s.map
        names = [name] if len(maps) > 1 or retrained else []
        names += [f"{s.data}/{s.split}"] if len(datasets) > 1 else []
        titles[s] = ": ".join(filter(None, (" on ".join(names), s.start)))
    return titles


def _condition(result: TrialResult) -> dict[str, Any]:
    """Return the properties that define the condition of a trial, by name: method, input, hardware and settings."""
    trial = result.trial
    options = {
        name: value for name, value in vars(trial.images).items() if name not in ("split", "masks", "mask_hides")
    }
    masks = trial.images.masks
    return {
        "method": result.method,
        "frames": len(trial.frames),
        "hidden": None if masks is None else f"{trial.images.mask_hides} of {masks}",
        "depth": trial.depth,
        **options,
        "backend": result.backend,
        "device": trial.device,
        **result.settings,
    }


WORDS: dict[str, Callable[[Any], str]] = {
    "frames": lambda count: amount(count, "image"),
    "depth": lambda used: "RGB-D" if used else "RGB",
    "hidden": lambda masks: "nothing hidden" if masks is None else f"{masks} hidden",
    "backend": str,
    "device": str,
}
"""Functions that put properties into words where they distinguish conditions; others read like ``depth weight 0.5``."""


def _labels(conditions: Sequence[dict[str, Any]]) -> dict[str, str]:
    """Return a label for each condition, by its JSON: the method, and the properties in which its conditions differ."""
    every = {json.dumps(condition, sort_keys=True): condition for condition in conditions}
    groups, labels = defaultdict[str, list[dict[str, Any]]](list), {}
    for own in every.values():
        groups[own["method"]].append(own)
    varying = {
        method: {name for name in set().union(*same) if len({json.dumps(own.get(name)) for own in same}) > 1}
        for method, same in groups.items()
    }
    for key, own in every.items():
        words = [own["method"]]
        for name in (name for name in own if name in varying[own["method"]]):
            value = f"{own[name]:.12g}" if isinstance(own[name], float) else str(own[name]).lower()
            words.append(WORDS[name](own[name]) if name in WORDS else f"{name.replace('_', ' ')} {value}")
        labels[key] = ", ".join(words)
    return labels


# Statistics.


@dataclass(frozen=True)
class Success:
    """The rate at which trials met a criterion, and the median steps and time of those that met it."""

    rate: Rate
    steps: float | None
    milliseconds: float | None


@dataclass(frozen=True, kw_only=True)
class Summary:
    """Statistics of a group of trials. A median is None if the middle value is unknown."""

    trials: int
    frames: int  # number of distinct frames, which limits the precision of the rates
    unit: LengthUnit  # of the errors
    success: dict[str, Success | None]  # by criterion; None if it does not apply
    translation: float | None  # median of the final errors
    rotation_deg: float | None  # median of the final errors
    steps: float  # median
    seconds: float  # median
    cpu_seconds: float  # median
    ms_per_step: float  # median
    peak_memory_bytes: int  # largest
    converged: int
    converged_but_wrong: int  # converged, and not within 5 degrees and 0.05
    right_but_not_converged: int


def summarize(results: Sequence[TrialResult]) -> Summary:
    """Return the statistics of at least one trial."""
    pairs = [(result.converged, is_right(result)) for result in results]
    errors = [result.error for result in results]
    return Summary(
        trials=len(results),
        frames=len({frame_label(result) for result in results}),
        unit=common_unit(results),
        success={name: success_of(results, name) for name in CRITERIA},
        translation=median(e.translation if e else None for e in errors),
        rotation_deg=median(e.rotation_deg if e else None for e in errors),
        steps=statistics.median(r.steps for r in results),
        seconds=statistics.median(r.seconds for r in results),
        cpu_seconds=statistics.median(r.cpu_seconds for r in results),
        ms_per_step=statistics.median(1000 * r.seconds / max(1, r.steps) for r in results),
        peak_memory_bytes=max(r.peak_memory_bytes for r in results),
        converged=sum(accepted for accepted, _ in pairs),
        converged_but_wrong=sum(accepted and not right for accepted, right in pairs),
        right_but_not_converged=sum(right and not accepted for accepted, right in pairs),
    )


def frame_label(result: TrialResult) -> tuple[str, str, tuple[str, ...]]:
    """Return the identity of a trial's images: trials of the same images are not independent."""
    return result.trial.data, result.trial.images.split, result.trial.frames


def applies(criterion: str, results: Sequence[TrialResult]) -> bool:
    """Return whether a criterion applies to every trial: a relative criterion needs a start."""
    needs_start = isinstance(CRITERIA[criterion], Reduced)
    return not needs_start or all(result.start_error is not None for result in results)


def are_stepwise(results: Sequence[TrialResult]) -> bool:
    """Return whether a method refined the pose in steps rather than answering at once."""
    return statistics.median(result.steps for result in results) > 1


def steps_of(results: Sequence[TrialResult], criterion: str) -> list[float]:
    """Return the steps to success of each trial, ``NEVER`` for those without success."""
    every = (steps_to_success(result.errors.as_error(), CRITERIA[criterion]) for result in results)
    return [NEVER if steps is None else float(steps) for steps in every]


def is_right(result: TrialResult) -> bool:
    """Return whether the final pose meets the ``ABSOLUTE`` criterion."""
    if result.error is None:
        return False
    error = Trace((result.error.translation,), (result.error.rotation_deg,)).as_error()
    return bool(CRITERIA[ABSOLUTE](error, error))


def success_of(results: Sequence[TrialResult], criterion: str) -> Success | None:
    """Return how often and how soon trials met a criterion; None if it does not apply to them."""
    if not applies(criterion, results):
        return None
    steps = steps_of(results, criterion)
    # The interval accounts for frames that were tried several times.
    rate = success_rate_by_frame([s < NEVER for s in steps], [frame_label(result) for result in results])
    # The time of a method without steps is that of the whole answer.
    reached = [
        (s, 1000 * (s * r.seconds / r.steps if r.steps > 1 else r.seconds))
        for s, r in zip(steps, results, strict=True)
        if s < NEVER
    ]
    return Success(rate, median(s for s, _ in reached), median(milliseconds for _, milliseconds in reached))


def median(values: Iterable[float | None]) -> float | None:
    """Return the median, or for an even number of values the mean of the middle two; an unknown value counts as infinite.

    Returns None if there are no values, or if a middle value is unknown.
    """
    known = [math.inf if value is None else float(value) for value in values]
    middle = statistics.median(known) if known else math.inf
    return middle if math.isfinite(middle) else None


def number_text(value: float | None, digits: int | None = None, unit: str = "") -> str:
    """Return a number as text, with a dash in place of an unknown one."""
    if value is None:
        return "\N{EN DASH}"
    return f"{value:g}{unit}" if digits is None else f"{value:.{digits}f}{unit}"
