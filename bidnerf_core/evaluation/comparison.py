"""Comparison of several maps on the same frames from the same starts: success and cost."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias

from bidnerf_core.datasets import open_dataset
from bidnerf_core.errors import InputError
from bidnerf_core.evaluation.protocols import find_protocol
from bidnerf_core.evaluation.summary import Success, summarize
from bidnerf_core.evaluation.trial import Trial, TrialResult
from bidnerf_core.evaluation.trial_process import Measured, TrialProcess
from bidnerf_core.maps.description import DESCRIPTION, load_info
from bidnerf_core.scenes.closed_form_data import closed_form_data, is_closed_form

ProgressCallback: TypeAlias = Callable[[int, int, Measured], None]
"""Called after each trial with the number of finished trials, the number of all, and the latest result."""


@dataclass(frozen=True)
class MapRow:
    """The statistics of one map in a comparison. Medians and means are over its trials."""

    map: str  # the shortest name that is unique among the maps
    backend: str
    weights: str  # file name, new with every training
    success: dict[str, Success | None]  # by criterion; None where it does not apply
    translation: float | None  # metres, median of the final errors; None where most are not finite
    rotation_deg: float | None
    steps: float  # median
    seconds: float  # median time of a trial
    ms_per_step: float  # median
    peak_memory_bytes: int  # of the process of this map
    samples_per_ray: float  # mean
    map_bytes: int  # size of the map's description and weights


@dataclass(frozen=True)
class Comparison:
    """The setup of a comparison, and one row per map in the order given."""

    data: str
    split: str
    protocol: str
    size: tuple[float, ...]
    method: str
    settings: dict[str, Any]
    seed: int
    trials: int  # on each map
    rows: tuple[MapRow, ...]
    results: tuple[tuple[TrialResult, ...], ...] = ()  # by map, in the same order of starts


def plan_comparison(
    usual: Trial, maps: Sequence[str], names: Sequence[str], count: int | None
) -> list[list[Trial]]:
    """Return, for each start, one trial per map, with the frames and seeds of the protocol.

    ``usual`` defines everything but the map and the frame; ``names`` are the frames to choose from, empty for all frames of
    the split. Raises ``InputError`` for a name or a number that cannot be used.
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


def compare_maps(planned: Sequence[Sequence[Trial]], progress: ProgressCallback) -> Comparison:
    """Run the planned trials: each map in its own process, and at each start one map after another.

    Only one process works at a time, so that a change in the machine's load affects all maps alike.
    """
    maps = [trial.map for trial in planned[0]]
    done: list[list[Measured]] = [[] for _ in maps]
    with ExitStack() as stack:
        processes = [stack.enter_context(TrialProcess()) for _ in maps]
        for number, trials in enumerate(planned):
            for place, (process, trial) in enumerate(zip(processes, trials, strict=True)):
                done[place].append(process.run(trial))
                progress(number * len(maps) + place + 1, len(planned) * len(maps), done[place][-1])
    first, result = planned[0][0], done[0][0].result
    return Comparison(
        Path(first.data).resolve().name, first.split, first.protocol, first.size, result.method, result.settings,
        first.seed, len(planned), tuple(map(map_row, map_labels(maps), maps, done)),
        tuple(tuple(m.result for m in column) for column in done),
    )  # fmt: skip


def map_row(label: str, folder: str, measured: Sequence[Measured]) -> MapRow:
    """Return the statistics of the trials on one map."""
    results = [m.result for m in measured]
    found = summarize(results)
    return MapRow(
        map=label,
        backend=results[0].backend,
        weights=results[0].weights,
        success=found.criteria,
        translation=found.translation,
        rotation_deg=found.rotation_deg,
        steps=found.steps,
        seconds=found.seconds,
        ms_per_step=found.milliseconds_per_step,
        peak_memory_bytes=found.peak_memory_bytes,
        samples_per_ray=statistics.fmean(m.samples_per_ray for m in measured),
        map_bytes=map_bytes(Path(folder)),
    )


def map_labels(maps: Sequence[str]) -> list[str]:
    """Return the folders' names, prefixed with as few of their parents as make them unique."""
    parts = [Path(m).resolve().parts for m in maps]
    length = 1
    while len({p[-length:] for p in parts}) < len(parts):
        length += 1
    return ["/".join(p[-length:]) for p in parts]


def map_bytes(folder: Path) -> int:
    """Return the size of a map's description and weights, without the state that an interrupted training keeps."""
    if is_closed_form(str(folder)):
        return 0
    return sum((folder / name).stat().st_size for name in (DESCRIPTION, load_info(folder).weights))


def _known(usual: Trial, names: Sequence[str]) -> list[str]:
    """Return the frames to choose from. Raises ``InputError`` for one that the split does not have."""
    data = usual.data
    dataset = closed_form_data(data) if is_closed_form(data) else open_dataset(data)
    known = dataset.frame_names(usual.split)
    missing = [name for name in names if name not in known]
    if missing:
        raise InputError(
            f"{data}: no frame {missing[0]!r} in split {usual.split!r}, expected names of its frames"
        )
    return list(names) or known
