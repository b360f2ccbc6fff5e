"""Results grouped by situation (what was to be localized) and by condition (what localized it)."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from bidnerf_core.evaluation.faults import NO_FAULT
from bidnerf_core.evaluation.trial import TrialResult
from bidnerf_core.io import parse_json


@dataclass(frozen=True)
class Situation:
    """The map, the images and the starts of some trials. ``size`` is None if trials of all sizes are pooled."""

    map: str
    weights: str  # identifies the training run, see ``Map.training``
    data: str
    split: str
    protocol: str
    size: tuple[float, ...] | None
    fault: str = NO_FAULT

    @property
    def start(self) -> str:
        """The start in words, with the image faults if any."""
        words = "no start" if self.protocol == "none" else self.protocol
        if self.size is None:
            words += ", all sizes"
        elif self.protocol != "none":
            words = f"{words} {' : '.join(f'{number:g}' for number in self.size)}".rstrip()
        return words if self.fault == NO_FAULT else f"{words}, {self.fault}"


@dataclass(frozen=True)
class Condition:
    """The method with its settings, and the input and hardware that it ran on."""

    method: str
    settings: str  # JSON of all of them
    images: int
    backend: str
    device: str
    depth: bool
    depth_points: str | None = None
    hidden: str | None = None  # the colour of masks, and their folder
    camera: str | None = None
    register_depth: bool | str | None = None
    depth_unit: float | None = None

    def facts(self) -> dict[str, Any]:
        """Return all properties that distinguish conditions, by name."""
        own = {
            "images": self.images,
            "depth": self.depth,
            "depth_points": self.depth_points,
            "hidden": self.hidden,
            "camera": self.camera,
            "register_depth": self.register_depth,
            "depth_unit": self.depth_unit,
        }
        own |= {"backend": self.backend, "device": self.device}
        return {"method": self.method, **own, **parse_json(self.settings, "settings", "an object")}


@dataclass(frozen=True)
class Group:
    """The trials of one condition in one situation."""

    situation: Situation
    condition: Condition
    label: str  # of the condition, among the others
    results: tuple[TrialResult, ...]


def grouped(results: Sequence[TrialResult]) -> list[Group]:
    """Group trial results by situation and condition, and add a pooled group for each condition tried at several sizes.

    Groups are sorted as in ``sorted_by_situation``.
    """
    found: dict[tuple[Situation, Condition], list[TrialResult]] = {}
    for result in results:
        found.setdefault((situation_of(result), condition_of(result)), []).append(result)
    names = condition_labels(list(dict.fromkeys(condition for _, condition in found)))
    groups = [Group(s, c, names[c], tuple(rows)) for (s, c), rows in found.items()]
    return sorted_by_situation([*groups, *_together(groups)])


def situations(groups: Sequence[Group]) -> list[Situation]:
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
        places = [name] if len(maps) > 1 or retrained else []
        places += [f"{s.data}/{s.split}"] if len(datasets) > 1 else []
        titles[s] = ": ".join([" on ".join(places), s.start] if places else [s.start])
    return titles


def situation_of(result: TrialResult) -> Situation:
    """Return the situation of a trial."""
    trial = result.trial
    return Situation(
        trial.map, result.weights, trial.data, trial.split, trial.protocol, trial.size, trial.fault
    )


def condition_of(result: TrialResult) -> Condition:
    """Return the condition of a trial."""
    trial, settings = result.trial, json.dumps(result.settings, sort_keys=True)
    images = len(trial.frames)
    return Condition(
        result.method, settings, images, result.backend, trial.device, trial.depth, trial.depth_points,
        None if trial.masks is None else f"{trial.mask_hides} of {trial.masks}",
        trial.camera, trial.register_depth, trial.depth_unit,
    )  # fmt: skip


def condition_labels(conditions: Sequence[Condition]) -> dict[Condition, str]:
    """Return a label for each condition: its method, and the properties in which that method's conditions differ."""
    named: dict[Condition, str] = {}
    for condition in conditions:
        same = [other.facts() for other in conditions if other.method == condition.method]
        own = condition.facts()
        odd = [name for name in own if any(other.get(name) != own[name] for other in same)]
        named[condition] = ", ".join([condition.method, *(_said(name, own[name]) for name in odd)])
    return named


def sorted_by_situation(groups: Sequence[Group]) -> list[Group]:
    """Sort by map, data and protocol in order of appearance, then by size, with the pooled sizes last."""
    places: dict[tuple[str, ...], int] = {}
    for group in groups:
        places.setdefault(_family(group.situation), len(places))
    return sorted(groups, key=lambda group: (places[_family(group.situation)], *_rank(group.situation)))


def _together(groups: Sequence[Group]) -> list[Group]:
    """Return a pooled group for each condition that was tried at several sizes."""
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


def _family(situation: Situation) -> tuple[str, ...]:
    place = situation.map, situation.weights, situation.data, situation.split
    return *place, situation.protocol, situation.fault


def _rank(situation: Situation) -> tuple[bool, tuple[float, ...]]:
    return situation.size is None, situation.size or ()


def _said(name: str, value: Any) -> str:
    if name == "images":
        return f"{value} image{'s' if value != 1 else ''}"
    if name == "depth":
        return "RGB-D" if value else "RGB"
    if name == "depth_points":
        return "no points" if value is None else f"points of {value}"
    if name == "hidden":
        return "nothing hidden" if value is None else f"{value} hidden"
    if name in ("backend", "device"):
        return str(value)
    shown = f"{value:g}" if isinstance(value, float) else "none" if value is None else str(value).lower()
    return f"{name.replace('_', ' ')} {shown}"
