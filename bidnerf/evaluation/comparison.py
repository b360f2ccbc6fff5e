"""Comparison of several maps on the same frames from the same starts: success and cost."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

from torch import nn

from bidnerf.evaluation.plan import Plan, list_trials
from bidnerf.evaluation.results import align_cells, as_line
from bidnerf.evaluation.run import (
    InThisProcess,
    data_name,
    device_name,
    local_processes,
    terminate_on_failure,
)
from bidnerf.evaluation.summary import ABSOLUTE, RELATIVE, Summary, number_text, summarize
from bidnerf.evaluation.trial import (
    MapSource,
    TrialResult,
    open_data,
    open_scene,
    registered_for,
    run_trial,
)
from bidnerf.scenes import is_closed_form
from bidnerf_core.errors import InputError, UsageError, amount, printable
from bidnerf_core.geometry import symbol
from bidnerf_core.io import to_plain, write_file
from bidnerf_core.maps import DESCRIPTION, Map, ViewSource, load_info, name_maps
from bidnerf_core.progress import (
    Cancel,
    Progress,
    ProgressCallback,
    check_cancelled,
    job_context,
    report_progress,
)


@dataclass(frozen=True, kw_only=True)
class MapRow(Summary):
    """The statistics of one map in a comparison."""

    map: str  # the shortest name that is unique among the maps
    backend: str
    weights: str  # identifies the training run, see ``Map.training``
    map_bytes: int  # size of the map's description and weights

    def cells(self) -> dict[str, str]:
        """Return the statistics as text, by name."""
        usual = self.success[RELATIVE] or self.success[ABSOLUTE]
        assert usual is not None  # the absolute criterion always applies
        rates = {
            f"success {name}": "-"
            if s is None
            else f"{s.rate.successes}/{s.rate.trials} ({100 * s.rate.low:.0f}-{100 * s.rate.high:.0f} %)"
            for name, s in self.success.items()
        }
        return {
            "backend": self.backend,
            **rates,
            "median error": f"{number_text(self.translation, 4)} {symbol(self.unit)}",
            "median error, deg": number_text(self.rotation_deg, 2),
            "CPU s a trial": f"{self.cpu_seconds:.2f}",
            "s a trial": f"{self.seconds:.2f}",
            "steps": f"{self.steps:g}",
            "steps to success": number_text(usual.steps, 0),
            "ms a step": f"{self.ms_per_step:.1f}",
            "ms to success": number_text(usual.milliseconds, 0),
            "peak memory, MiB": f"{self.peak_memory_bytes / 2**20:.0f}",
            "map, MiB": f"{self.map_bytes / 2**20:.1f}",
        }


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
        trials = amount(self.trials, "trial" if self.protocol == "none" else "start")
        start = "without a start" if self.protocol == "none" else f"of {self.protocol} {size}".rstrip()
        return f"{trials} {start} on {self.data}/{self.split}, method {self.method}"

    def __str__(self) -> str:
        stepwise = any(row.steps > 1 for row in self.rows)
        columns = [row.cells() for row in self.rows]
        names = [name for name in columns[0] if stepwise or "step" not in name]
        lines = [
            ["", *(row.map for row in self.rows)],
            *([n, *(cells[n] for cells in columns)] for n in names),
        ]
        usual = RELATIVE if self.rows[0].success[RELATIVE] else ABSOLUTE
        note = f"success: number and Wilson's 95 % interval; to success: median of the trials that met {usual};"
        note += " times are those of a clock except CPU s, which other processes do not lengthen"
        return "\n".join([printable(self.title), align_cells(lines), note])

    def save(self, path: str | Path) -> None:
        """Write the comparison with all results as JSON."""
        results = [[result.plain() for result in column] for column in self.results]
        write_file(Path(path), as_line(to_plain(replace(self, results=())) | {"results": results}))


def compare(
    scenes: Sequence[MapSource] | Mapping[str, MapSource],
    data: ViewSource,
    plan: Plan | None = None,
    *,
    progress: ProgressCallback | None = None,
    cancel: Cancel | None = None,
) -> Comparison:
    """Localize the same frames from the same starts in several maps, and return the success and cost of each.

    The plan must have a single size of starts, by default the first of its protocol. ``scenes`` may be a dictionary, whose keys
    then name the maps. Each map in a folder runs in its own process, so that its peak memory can be measured; this requires an
    importable main module. Maps in memory, and all maps if the data is in memory, run in this process. One trial runs at a time,
    so that a change in the machine's load affects all maps alike. Raises ``InputError`` and ``Cancelled`` as ``evaluate`` does,
    and ``InputError`` for a map that is given twice.
    """
    if isinstance(scenes, str | Path | Map):
        name = scenes.info.backend if isinstance(scenes, Map) else scenes
        raise InputError(f"scenes is the one map {name}", expected="a list of maps, or a dictionary of them")
    if not scenes:
        raise InputError("no maps to compare", expected="at least one")
    sources = scenes if isinstance(scenes, Mapping) else name_maps(scenes)
    plan = plan or Plan()
    if len(plan.sizes or ()) > 1 or len(plan.faults) > 1:
        raise UsageError("maps are compared from one kind of start", expected="one size and one fault")
    with job_context(progress, cancel), ExitStack() as stack:
        for source in sources.values():
            if not isinstance(source, Map) and not is_closed_form(str(source)):
                load_info(Path(source))  # raises before any work for what is not a map
        here = {
            name: open_scene(source, data, plan)
            for name, source in sources.items()
            if isinstance(source, Map) or not isinstance(data, str | Path)
        }
        dataset = next((capture for _, capture in here.values()), None) or open_data(data, plan.images)
        trials = list_trials(plan, "", data_name(data, dataset), dataset)
        starts = [trial for trial in trials if trial.size == trials[0].size]
        executors = {
            name: stack.enter_context(terminate_on_failure(InThisProcess() if name in here else local_processes(1)))
            for name in sources
        }
        turns = list(product(starts, sources))
        results: dict[str, list[TrialResult]] = {name: [] for name in sources}
        for number, (start, name) in enumerate(turns, start=1):
            check_cancelled("comparison")
            device = device_name(sources[name], plan.device)
            trial = replace(start, map=name if name in here else str(sources[name]), device=device)
            try:
                results[name].append(
                    executors[name].submit(run_trial, trial, here.get(name), registered_for(trial)).result()
                )
            except BrokenProcessPool as error:
                raise InputError(
                    f"the process that localized frame {trial.frame} ended",
                    where=trial.map,
                    expected="a result; was memory short, or does the main module begin work outside of"
                    " 'if __name__ == \"__main__\"'?",
                ) from error
            report_progress(Progress("comparison", number, len(turns), "trials", f"{trial.frame} in {name}"))
    rows = [
        MapRow(
            map=name,
            backend=results[name][0].backend,
            weights=results[name][0].weights,
            map_bytes=map_bytes(source),
            **vars(summarize(results[name])),
        )
        for name, source in sources.items()
    ]
    first = next(iter(results.values()))[0]
    return Comparison(
        first.trial.data,
        first.trial.images.split,
        first.trial.protocol,
        first.trial.size,
        first.method,
        first.settings,
        first.seed,
        len(starts),
        tuple(rows),
        tuple(map(tuple, results.values())),
    )


def map_bytes(source: MapSource) -> int:
    """Return the size of a map: its description and weights in a folder, or its field's tensors; 0 in closed form."""
    if isinstance(source, Map):
        state = source.field.state_dict() if isinstance(source.field, nn.Module) else {}
        return sum(tensor.numel() * tensor.element_size() for tensor in state.values())
    if is_closed_form(str(source)):
        return 0
    folder = Path(source)
    return sum((folder / name).stat().st_size for name in (DESCRIPTION, load_info(folder).weights))
