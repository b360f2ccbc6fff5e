"""Comparison of several maps on the same frames from the same starts: success and cost."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from torch import nn

from bidnerf_core.datasets import Capture
from bidnerf_core.errors import amount, printable
from bidnerf_core.evaluation.bench import Plan, planned
from bidnerf_core.evaluation.json_lines import as_line
from bidnerf_core.evaluation.results import aligned
from bidnerf_core.evaluation.summary import ABSOLUTE, RELATIVE, Success, summarize
from bidnerf_core.evaluation.trial import Trial, TrialResult
from bidnerf_core.evaluation.trials import Opened
from bidnerf_core.evaluation.workers import Measured, TrialProcess, measured
from bidnerf_core.geometry import LengthUnit, symbol
from bidnerf_core.io import to_plain, write_file
from bidnerf_core.maps import DESCRIPTION, Map, load_info
from bidnerf_core.progress import Cancel, Progress, ProgressCallback, check_cancelled
from bidnerf_core.results import CRITERIA
from bidnerf_core.scenes import is_closed_form


@dataclass(frozen=True)
class MapRow:
    """The statistics of one map in a comparison. Medians and means are over its trials."""

    map: str  # the shortest name that is unique among the maps
    backend: str
    weights: str  # identifies the training run, see ``Map.training``
    success: dict[str, Success | None]  # by criterion; None if it does not apply
    unit: LengthUnit  # of the map
    translation: float | None  # median of the final errors; None if most are not finite
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

    @property
    def title(self) -> str:
        """The setup in words."""
        size = ":".join(f"{x:g}" for x in self.size)
        trials = f"{self.trials} trials" if self.protocol == "none" else f"{self.trials} starts of"
        start = "without a start" if self.protocol == "none" else f"{self.protocol} {size}".rstrip()
        return f"{trials} {start} on {self.data}/{self.split}, method {self.method}"

    def __str__(self) -> str:
        lines = [["", *(row.map for row in self.rows)]]
        lines += [[name, *map(cell, self.rows)] for name, cell in LINES.items()]
        usual = RELATIVE if self.rows[0].success[RELATIVE] else ABSOLUTE
        note = (
            f"success: number and Wilson's 95 % interval; to success: median of the trials that met {usual}"
        )
        return "\n".join([printable(self.title), aligned(lines), note])

    def save(self, path: str | Path) -> None:
        """Write the comparison with all results as JSON."""
        write_file(Path(path), as_line(to_plain(self)))


def plan_comparison(plan: Plan, maps: Sequence[str], dataset: Capture) -> list[list[Trial]]:
    """Return, for each start, one trial per map, with the frames and seeds of the protocol.

    ``plan`` defines everything but the map. Raises ``InputError`` for a name or a number that cannot be used.
    """
    return [[replace(trial, map=m) for m in maps] for trial in planned(plan, dataset)]


def compare_maps(
    starts: Sequence[Sequence[Trial]],
    labels: Sequence[str],
    scenes: Sequence[Opened | None],
    progress: ProgressCallback | None = None,
    cancel: Cancel | None = None,
) -> Comparison:
    """Run the trials of each start, one map after another; a map without an entry in ``scenes`` runs in its
    own process.

    Only one process works at a time, so that a change in the machine's load affects all maps alike. Raises
    ``Cancelled`` once ``cancel`` returns True.
    """
    done: list[list[Measured]] = [[] for _ in labels]
    with ExitStack() as stack:
        processes = [stack.enter_context(TrialProcess()) if scene is None else None for scene in scenes]
        for number, trials in enumerate(starts):
            for place, (process, trial) in enumerate(zip(processes, trials, strict=True)):
                check_cancelled("comparison", cancel)
                done[place].append(process.run(trial) if process else measured(trial, scenes[place]))
                if progress is not None:
                    count = number * len(labels) + place + 1
                    text = _found(labels[place], done[place][-1].result)
                    progress(Progress("comparison", count, len(starts) * len(labels), "trials", text))
    first, result = starts[0][0], done[0][0].result
    rows = [
        map_row(label, map_bytes(trial.map if scene is None else scene[0]), column)
        for label, trial, scene, column in zip(labels, starts[0], scenes, done, strict=True)
    ]
    return Comparison(
        first.portable.data, first.split, first.protocol, first.size, result.method, result.settings,
        first.seed, len(starts), tuple(rows), tuple(tuple(m.result for m in column) for column in done),
    )  # fmt: skip


def _found(label: str, result: TrialResult) -> str:
    """Describe the outcome of a trial in words."""
    error = result.error
    off = (
        f"{error.translation:.3f} {symbol(result.unit)}, {error.rotation_deg:.2f} deg"
        if error
        else "not finite"
    )
    return f"{result.frame} in {label}: {off}, {amount(result.steps, 'step')}, {result.seconds:.1f} s"


def map_row(label: str, size: int, measured: Sequence[Measured]) -> MapRow:
    """Return the statistics of the trials on one map whose size is ``size`` bytes."""
    results = [m.result for m in measured]
    found = summarize(results)
    return MapRow(
        map=label,
        backend=results[0].backend,
        weights=results[0].weights,
        success=found.criteria,
        unit=found.unit,
        translation=found.translation,
        rotation_deg=found.rotation_deg,
        steps=found.steps,
        seconds=found.seconds,
        ms_per_step=found.milliseconds_per_step,
        peak_memory_bytes=found.peak_memory_bytes,
        samples_per_ray=statistics.fmean(m.samples_per_ray for m in measured),
        map_bytes=size,
    )


def map_labels(maps: Sequence[str]) -> list[str]:
    """Return the folders' names, prefixed with as few of their parents as make them unique."""
    parts = [Path(m).resolve().parts for m in maps]
    length = 1
    while len({p[-length:] for p in parts}) < len(parts):
        length += 1
    return ["/".join(p[-length:]) for p in parts]


def map_bytes(stored: Map | str | Path) -> int:
    """Return the size of a map's description and weights in a folder, or of the field's tensors in memory; 0 in closed form."""
    if isinstance(stored, Map):
        if not isinstance(stored.field, nn.Module):
            return 0
        return sum(t.numel() * t.element_size() for t in stored.field.state_dict().values())
    if is_closed_form(str(stored)):
        return 0
    folder = Path(stored)
    return sum((folder / name).stat().st_size for name in (DESCRIPTION, load_info(folder).weights))


def _rate(row: MapRow, criterion: str) -> str:
    success = row.success[criterion]
    if success is None:
        return "-"
    rate = success.rate
    return f"{rate.successes}/{rate.trials} ({100 * rate.low:.0f}-{100 * rate.high:.0f} %)"


def _usual(row: MapRow) -> Success:
    """Return the success by the relative criterion, or by the absolute one if there was no start."""
    success = row.success[RELATIVE] or row.success[ABSOLUTE]
    assert success is not None  # the absolute criterion always applies
    return success


def _known(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


LINES: dict[str, Callable[[MapRow], str]] = {
    "backend": lambda row: row.backend,
    **{f"success {name}": partial(_rate, criterion=name) for name in CRITERIA},
    "median error": lambda row: f"{_known(row.translation, 4)} {symbol(row.unit)}",
    "median error, deg": lambda row: _known(row.rotation_deg, 2),
    "steps": lambda row: f"{row.steps:g}",
    "steps to success": lambda row: _known(_usual(row).steps, 0),
    "ms a step": lambda row: f"{row.ms_per_step:.1f}",
    "ms to success": lambda row: _known(_usual(row).milliseconds, 0),
    "peak memory, MiB": lambda row: f"{row.peak_memory_bytes / 2**20:.0f}",
    "samples a ray": lambda row: f"{row.samples_per_ray:.1f}",
    "map, MiB": lambda row: f"{row.map_bytes / 2**20:.1f}",
}
"""The lines of a comparison as text, by name; each map has a column."""
