"""Results put side by side: what was asked (situation) and what answered (condition)."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from bidnerf_core.evaluation.trials import TrialResult


@dataclass(frozen=True)
class Situation:
    """Where trials began, and in which map. ``size`` is none where all sizes are taken together."""

    map: str
    weights: str  # which training of it
    data: str
    split: str
    protocol: str
    size: tuple[float, ...] | None

    @property
    def start(self) -> str:
        """The start in words."""
        if self.size is None:
            return f"{self.protocol}, all sizes"
        numbers = " : ".join(f"{number:g}" for number in self.size)
        return f"{self.protocol} {numbers}".rstrip()


@dataclass(frozen=True)
class Condition:
    """What was tried there."""

    method: str
    settings: str  # JSON of all of them
    images: int
    backend: str
    device: str
    depth: bool
    depth_points: str | None = None

    def facts(self) -> dict[str, Any]:
        """What tells conditions apart, by name."""
        own = {"images": self.images, "depth": self.depth, "depth_points": self.depth_points}
        own |= {"backend": self.backend, "device": self.device}
        return {"method": self.method, **own, **json.loads(self.settings)}


@dataclass(frozen=True)
class Group:
    situation: Situation
    condition: Condition
    label: str  # of the condition, among the others
    results: tuple[TrialResult, ...]


def grouped(results: Sequence[TrialResult]) -> list[Group]:
    """All groups, situations and conditions in the order in which they appear; "all sizes" behind the sizes."""
    found: dict[tuple[Situation, Condition], list[TrialResult]] = {}
    for result in results:
        found.setdefault((situation_of(result), condition_of(result)), []).append(result)
    names = labels(list(dict.fromkeys(condition for _, condition in found)))
    groups = [Group(s, c, names[c], tuple(rows)) for (s, c), rows in found.items()]
    return sorted_by_situation([*groups, *_together(groups)])


def situations(groups: Sequence[Group]) -> list[Situation]:
    return list(dict.fromkeys(group.situation for group in groups))


def situation_of(result: TrialResult) -> Situation:
    trial = result.trial
    return Situation(trial.map, result.weights, trial.data, trial.split, trial.protocol, trial.size)


def condition_of(result: TrialResult) -> Condition:
    trial, settings = result.trial, json.dumps(result.settings, sort_keys=True)
    images = len(trial.frames)
    return Condition(
        result.method, settings, images, result.backend, trial.device, trial.depth, trial.depth_points
    )


def labels(conditions: Sequence[Condition]) -> dict[Condition, str]:
    """The method's name and, of all else, what not all conditions of that method have in common."""
    named: dict[Condition, str] = {}
    for condition in conditions:
        same = [other.facts() for other in conditions if other.method == condition.method]
        own = condition.facts()
        odd = [name for name in own if any(other.get(name) != own[name] for other in same)]
        named[condition] = ", ".join([condition.method, *(_said(name, own[name]) for name in odd)])
    return named


def sorted_by_situation(groups: Sequence[Group]) -> list[Group]:
    """Situations of one map and protocol together, sizes from small to large, then all of them."""
    places: dict[tuple[str, ...], int] = {}
    for group in groups:
        places.setdefault(_family(group.situation), len(places))
    return sorted(groups, key=lambda group: (places[_family(group.situation)], *_rank(group.situation)))


def _together(groups: Sequence[Group]) -> list[Group]:
    """For each condition that was tried at several sizes, all of them in one."""
    found: dict[tuple[tuple[str, ...], Condition], list[Group]] = {}
    for group in groups:
        found.setdefault((_family(group.situation), group.condition), []).append(group)
    return [
        Group(
            replace(same[0].situation, size=None), same[0].condition, same[0].label,
            tuple(result for group in same for result in group.results),
        )
        for same in found.values()
        if len(same) > 1
    ]  # fmt: skip


def _family(situation: Situation) -> tuple[str, str, str, str, str]:
    return situation.map, situation.weights, situation.data, situation.split, situation.protocol


def _rank(situation: Situation) -> tuple[bool, tuple[float, ...]]:
    return situation.size is None, situation.size or ()


def _said(name: str, value: Any) -> str:
    if name == "images":
        return f"{value} image{'s' if value != 1 else ''}"
    if name == "depth":
        return "RGB-D" if value else "RGB"
    if name == "depth_points":
        return "no points" if value is None else f"points of {value}"
    if name in ("backend", "device"):
        return str(value)
    shown = f"{value:g}" if isinstance(value, float) else "none" if value is None else str(value).lower()
    return f"{name.replace('_', ' ')} {shown}"
