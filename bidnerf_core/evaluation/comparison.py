"""Several maps tried on the same frames from the same starts: what each finds, and what that costs."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias

from bidnerf_core.datasets import open_dataset
from bidnerf_core.errors import InputError
from bidnerf_core.evaluation.closed_form_data import closed_form_data, is_closed_form
from bidnerf_core.evaluation.errors import CRITERIA, Rate, steps_to_success, success_rate
from bidnerf_core.evaluation.protocols import find_protocol
from bidnerf_core.evaluation.trial_process import Measured, TrialProcess
from bidnerf_core.evaluation.trials import Trial, TrialResult
from bidnerf_core.storage import DESCRIPTION, load_info

USUAL = "10%"
"""The criterion by which speed is told where there is room for one."""

Told: TypeAlias = Callable[[int, int, Measured], None]
"""Hears of each finished trial: how many are done, of how many, and what came of the last."""


@dataclass(frozen=True)
class Reached:
    """How often a criterion was met, and how soon where it was: medians over the trials that met it."""

    rate: Rate
    steps: float | None
    milliseconds: float | None


@dataclass(frozen=True)
class MapRow:
    """One map in a comparison. Medians and means are over its trials."""

    map: str  # as short as tells it from the others
    backend: str
    weights: str  # which training of it
    success: dict[str, Reached]  # by criterion
    translation: float | None  # metres, median of the final errors; none where most are not finite
    rotation_deg: float | None
    steps: float  # median
    seconds: float  # median of a trial's
    ms_per_step: float  # median
    peak_memory_bytes: int  # of the process that had this map alone
    samples_per_ray: float  # mean
    map_bytes: int  # of what localizing reads


@dataclass(frozen=True)
class Comparison:
    """What was done, and one row a map, in the order in which they were named."""

    data: str
    split: str
    protocol: str
    size: tuple[float, ...]
    method: str
    settings: dict[str, Any]
    seed: int
    trials: int  # of each map
    rows: tuple[MapRow, ...]
    results: tuple[tuple[TrialResult, ...], ...] = ()  # of each map, in the same order of starts


def plan(usual: Trial, maps: Sequence[str], names: Sequence[str], count: int | None) -> list[list[Trial]]:
    """For each start, one trial a map. Frames and seeds are those of the protocol's plan.

    ``usual`` says all but the map and the frame; ``names`` are the frames to choose from, all of the split where empty.
    Raises ``InputError`` where a name or a number is not usable.
    """
    if len({Path(m).resolve() for m in maps}) != len(maps):
        raise InputError(f"maps: {', '.join(maps)}: one is named twice, expected different ones")
    protocol = find_protocol(usual.protocol)
    protocol.check_size(usual.size)
    if protocol.fixed and names:
        raise InputError(f"protocol {usual.protocol!r} has its own frames, expected no others to be named")
    frames = _known(usual, names)
    cases = protocol.cases(len(frames), protocol.trials if count is None else count, usual.seed)
    return [
        [replace(usual, map=m, frames=(frames[place],), seed=seed) for m in maps] for place, seed in cases
    ]


def compare(planned: Sequence[Sequence[Trial]], told: Told) -> Comparison:
    """Run what was planned: each map in a process of its own, and the maps in turn at each start.

    Whatever else the machine does meanwhile so disturbs all of them alike. Only one of them works at a time.
    """
    maps = [trial.map for trial in planned[0]]
    done: list[list[Measured]] = [[] for _ in maps]
    with ExitStack() as stack:
        processes = [stack.enter_context(TrialProcess()) for _ in maps]
        for number, trials in enumerate(planned):
            for place, (process, trial) in enumerate(zip(processes, trials, strict=True)):
                done[place].append(process.run(trial))
                told(number * len(maps) + place + 1, len(planned) * len(maps), done[place][-1])
    first, result = planned[0][0], done[0][0].result
    return Comparison(
        Path(first.data).resolve().name, first.split, first.protocol, first.size, result.method, result.settings,
        first.seed, len(planned), tuple(map(row, labels(maps), maps, done)),
        tuple(tuple(m.result for m in column) for column in done),
    )  # fmt: skip


def row(label: str, folder: str, measured: Sequence[Measured]) -> MapRow:
    results = [m.result for m in measured]
    finals = [r.error for r in results]
    translation, rotation = (
        _median([getattr(e, what) if e else None for e in finals]) for what in ("translation", "rotation_deg")
    )
    return MapRow(
        label, results[0].backend, results[0].weights,
        {name: reached(results, name) for name in CRITERIA}, translation, rotation,
        statistics.median(r.steps for r in results), statistics.median(r.seconds for r in results),
        statistics.median(_ms_per_step(r) for r in results), max(r.peak_memory_bytes for r in results),
        statistics.fmean(m.samples_per_ray for m in measured), map_bytes(Path(folder)),
    )  # fmt: skip


def reached(results: Sequence[TrialResult], criterion: str) -> Reached:
    """Over trials that began from a start; the error of the start belongs to the first criterion."""
    steps = [steps_to_success(r.errors.as_error(), CRITERIA[criterion]) for r in results]
    soon = [(s, s * _ms_per_step(r)) for s, r in zip(steps, results, strict=True) if s is not None]
    rate = success_rate(len(soon), len(results))
    if not soon:
        return Reached(rate, None, None)
    return Reached(rate, statistics.median(s for s, _ in soon), statistics.median(ms for _, ms in soon))


def seconds_to_success(results: Sequence[TrialResult], criterion: str) -> list[float]:
    """Of the trials that met the criterion, the quickest first."""
    steps = ((steps_to_success(r.errors.as_error(), CRITERIA[criterion]), r) for r in results)
    return sorted(s * _ms_per_step(r) / 1000 for s, r in steps if s is not None)


def labels(maps: Sequence[str]) -> list[str]:
    """The folders' names where these tell them apart, else as much more of their paths as is needed."""
    parts = [Path(m).resolve().parts for m in maps]
    length = 1
    while len({p[-length:] for p in parts}) < len(parts):
        length += 1
    return ["/".join(p[-length:]) for p in parts]


def map_bytes(folder: Path) -> int:
    """Of the description and the weights; not of what an interrupted training keeps for itself."""
    if is_closed_form(str(folder)):
        return 0
    return sum((folder / name).stat().st_size for name in (DESCRIPTION, load_info(folder).weights))


def _known(usual: Trial, names: Sequence[str]) -> list[str]:
    """The frames to choose from, of which each is there."""
    data = usual.data
    dataset = closed_form_data(data) if is_closed_form(data) else open_dataset(data)
    known = dataset.frame_names(usual.split)
    missing = [name for name in names if name not in known]
    if missing:
        raise InputError(
            f"{data}: no frame {missing[0]!r} in split {usual.split!r}, expected names of its frames"
        )
    return list(names) or known


def _ms_per_step(result: TrialResult) -> float:
    return 1000 * result.seconds / max(1, result.steps)


def _median(values: Sequence[float | None]) -> float | None:
    """With what is not known counted as larger than all."""
    middle = sorted(values, key=lambda v: (v is None, v or 0.0))[len(values) // 2]
    return middle
