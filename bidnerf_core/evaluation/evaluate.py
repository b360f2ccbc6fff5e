"""Evaluation from Python: many localizations in one map as a table, and several maps side by side."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeAlias

from bidnerf_core.datasets import Capture, of_views
from bidnerf_core.errors import Cancelled, InputError, amount, refuse_text
from bidnerf_core.evaluation.bench import (
    Plan,
    changed_settings,
    check_points,
    left_to_do,
    planned,
    repeated_frames,
    run_trials,
    shard_of,
)
from bidnerf_core.evaluation.comparison import Comparison, compare_maps, map_labels, plan_comparison
from bidnerf_core.evaluation.protocols import Size, find_protocol
from bidnerf_core.evaluation.provenance import note_run, provenance, script_command
from bidnerf_core.evaluation.results import ResultsFile, ResultTable, key_of
from bidnerf_core.evaluation.trial import Trial
from bidnerf_core.evaluation.trials import Opened, Reading, open_map
from bidnerf_core.evaluation.workers import workers_for
from bidnerf_core.fields import device_of
from bidnerf_core.frames import HiddenColour, View
from bidnerf_core.localization import settings_of
from bidnerf_core.maps import Map, load_info
from bidnerf_core.progress import Cancel, ProgressCallback
from bidnerf_core.scenes import is_closed_form

log = logging.getLogger("bidnerf")

Scene: TypeAlias = Map | str | Path
"""A map in memory, the folder of a map, or demo:NAME."""
Data: TypeAlias = Capture | Sequence[View] | str | Path
"""A dataset in memory, posed images (T_world_camera), the folder of a dataset, or demo:NAME."""


def evaluate(
    scene: Scene,
    data: Data,
    *,
    protocol: str = "none",
    sizes: Sequence[float | Sequence[float]] | None = None,
    method: str = "auto",
    config: Any = None,
    trials: int | None = None,
    seed: int | None = None,
    split: str = "test",
    frames: Sequence[str] | None = None,
    depth: bool = True,
    masks: str | Path | None = None,
    mask_hides: HiddenColour = "black",
    faults: Sequence[str] = (),
    device: str = "cpu",
    workers: int | None = 1,
    out: str | Path | None = None,
    progress: ProgressCallback | None = None,
    cancel: Cancel | None = None,
) -> ResultTable:
    """Localize many frames of ``data`` in a map, from the starts of a protocol or from none, and return all results.

    ``protocol`` chooses frames, seeds and starts; ``sizes`` are the errors of the start in its units, ``trials`` is the number
    of trials per size, and None selects the protocol's own values. ``config`` holds the method's settings: an instance of their
    type, or a dictionary of those that differ from the defaults. ``faults`` are applied to the images, such as
    ``"depth-scale:1.02"``. ``masks`` is a folder of image masks, in which ``mask_hides`` is the colour that is ignored.
    ``device`` is used for a map read from a folder.

    ``out`` is a results file: trials already in it are not run again, and each result is on disk before the next trial
    begins, so that the same call resumes an evaluation that was interrupted or cancelled. ``workers`` is the number of
    processes (None: one per core); more than one requires a map and data in folders and an importable main module, and finds
    registered names only if importing that module registers them. With one, everything runs in the calling thread.

    Raises ``InputError`` for an evaluation that cannot be carried out, and ``Cancelled`` once ``cancel`` returns True and the
    running trials have ended.
    """
    for what, given in (("faults", faults), ("frames", frames), ("sizes", sizes)):
        refuse_text(what, given)
    plan = Plan(
        map=_name(scene), data=_name(data), protocol=protocol, sizes=_sizes(sizes), method=method,
        config=_config(method, config), trials=trials, seed=seed, split=split,
        frames=None if frames is None else tuple(frames), device=_device(scene, device), depth=depth,
        masks=None if masks is None else str(masks), mask_hides=mask_hides, faults=tuple(faults),
    )  # fmt: skip
    in_memory = isinstance(scene, Map) or not isinstance(data, str | Path)
    if in_memory and workers not in (1, None):
        raise InputError(
            f"workers is {workers}",
            expected="1: other processes read the map and the data from folders, and these are in memory",
        )
    opened = _opened(scene, data, plan) if in_memory else None
    return run_plan(
        plan, opened, workers=1 if in_memory else workers, out=out, progress=progress, cancel=cancel
    )


def run_plan(
    plan: Plan,
    scene: Opened | None = None,
    *,
    shard: int = 0,
    shards: int = 1,
    workers: int | None = 1,
    dask: str | None = None,
    out: str | Path | None = None,
    command: str | None = None,
    progress: ProgressCallback | None = None,
    cancel: Cancel | None = None,
) -> ResultTable:
    """Run the trials of a plan, or one of ``shards`` parts, as ``evaluate`` does.

    ``scene`` is the map and the dataset in memory, by default those named by the plan. ``dask`` is the
    address of a scheduler whose workers run the trials, and ``command`` is recorded next to the results as
    their origin.
    """
    if dask is not None and workers not in (1, None):
        raise InputError("workers and dask contradict each other: a cluster has its own workers")
    opened = scene or _opened(plan.map, plan.data, plan)
    every = planned(plan, opened[1])
    check_points(plan, every, opened)
    if repeated := repeated_frames(every):
        log.info(repeated)
    trials = shard_of(every, shard, shards)
    with ResultsFile(None if out is None else Path(out)) as file:
        todo = left_to_do(trials, file, opened)
        _note_kept(trials, todo, file)
        if todo:
            on_cpu = plan.device == "cpu"
            with workers_for(len(todo), on_cpu, workers, dask) as (executor, at_once, what):
                if file.path is not None:
                    note_run(file.path, provenance(command or script_command(), what))
                here = opened if dask is None and at_once == 1 else None
                try:
                    run_trials(todo, file, executor, at_once, progress, cancel, here)
                except BrokenProcessPool as error:
                    raise InputError(
                        f"a worker process died (is there enough memory for {at_once} of them?); finished"
                        f" trials are kept{_where(file)}, the same command resumes"
                    ) from error
            _check_complete(trials, file)
        file.put_in_order(trials)
        return ResultTable(tuple(file.results[key_of(trial)] for trial in trials))


def compare(
    scenes: Sequence[Scene] | Mapping[str, Scene],
    data: Data,
    *,
    protocol: str = "none",
    size: float | Sequence[float] | None = None,
    method: str = "auto",
    config: Any = None,
    trials: int | None = None,
    seed: int | None = None,
    split: str = "test",
    frames: Sequence[str] | None = None,
    depth: bool = True,
    masks: str | Path | None = None,
    mask_hides: HiddenColour = "black",
    device: str = "cpu",
    progress: ProgressCallback | None = None,
    cancel: Cancel | None = None,
) -> Comparison:
    """Localize the same frames from the same starts in several maps, and return the success and cost of each.

    Arguments are as for ``evaluate``, with one size. ``scenes`` may be a dictionary, whose keys then name the
    maps. Maps in folders run in a process each, whose peak memory is measured; maps in memory, and all maps
    if the data is in memory, run in this process. One trial runs at a time. Raises ``InputError`` and
    ``Cancelled`` as ``evaluate`` does.
    """
    refuse_text("frames", frames)
    plan = Plan(
        map="", data=_name(data), protocol=protocol,
        sizes=find_protocol(protocol).sizes[:1] if size is None else _sizes([size]), method=method,
        config=_config(method, config), trials=trials, seed=seed, split=split,
        frames=None if frames is None else tuple(frames), device=device, depth=depth,
        masks=None if masks is None else str(masks), mask_hides=mask_hides,
    )  # fmt: skip
    return run_comparison(plan, scenes, data, progress=progress, cancel=cancel)


def run_comparison(
    plan: Plan,
    scenes: Sequence[Scene] | Mapping[str, Scene],
    data: Data | None = None,
    *,
    progress: ProgressCallback | None = None,
    cancel: Cancel | None = None,
) -> Comparison:
    """Run a plan of one size on each of several maps, as ``compare`` does; the plan's own map is ignored.

    ``data`` defaults to the data named by the plan.
    """
    if isinstance(scenes, str | Path | Map):
        raise InputError(
            f"scenes is the one map {_name(scenes)}", expected="a list of maps, or a dictionary of them"
        )
    named = dict(scenes) if isinstance(scenes, Mapping) else _named(scenes)
    if not named:
        raise InputError("no maps to compare", expected="at least one")
    data = plan.data if data is None else data
    opened = {
        name: _opened(scene, data, plan) if isinstance(scene, Map) or not isinstance(data, str | Path) else None
        for name, scene in named.items()
    }  # fmt: skip
    dataset = next((known[1] for known in opened.values() if known is not None), None) or _dataset(data, plan)
    places = [name if opened[name] is not None else str(scene) for name, scene in named.items()]
    devices = [_device(scene, plan.device) for scene in named.values()]
    starts = [
        [replace(trial, device=device) for trial, device in zip(trials, devices, strict=True)]
        for trials in plan_comparison(plan, places, dataset)
    ]
    folders = [place for place, known in zip(places, opened.values(), strict=True) if known is None]
    for folder in folders:
        if not is_closed_form(folder):
            load_info(Path(folder))
    begins = "; a process for each begins" if folders else ""
    log.info("%s in %s%s", amount(len(starts), "start"), amount(len(named), "map"), begins)
    return compare_maps(starts, list(named), list(opened.values()), progress, cancel)


def _note_kept(trials: Sequence[Trial], todo: Sequence[Trial], file: ResultsFile) -> None:
    """Log how many trials are not run again, and how many results of an earlier version cannot be checked."""
    if len(todo) < len(trials):
        log.info("%s: %d of %d trials are already there", file.path, len(trials) - len(todo), len(trials))
    known = [file.results.get(key_of(trial)) for trial in trials]
    count = sum(result is not None and result.inputs is None for result in known)
    if count:
        log.info(
            "%s: %d results of an earlier version do not record their images and are kept unchecked", file.path, count
        )  # fmt: skip


def _check_complete(trials: Sequence[Trial], file: ResultsFile) -> None:
    """Raise ``Cancelled`` if trials have no result, which happens only if they were not started."""
    left = sum(key_of(trial) not in file.results for trial in trials)
    if left:
        are = "is" if left == 1 else "are"
        kept = "nothing is kept without a results file" if file.path is None else "the same command resumes"
        raise Cancelled(f"stopped; {amount(left, 'trial')} {are} left{_where(file)}, {kept}")


def _where(file: ResultsFile) -> str:
    return "" if file.path is None else f" in {file.path}"


def _opened(scene: Scene, data: Data, plan: Plan) -> Opened:
    """Return the map and the dataset, each read from its folder unless it is in memory."""
    stored = scene if isinstance(scene, Map) else open_map(str(scene), plan.device)
    return stored, _dataset(data, plan, stored)


def _dataset(data: Data, plan: Plan, stored: Map | None = None) -> Capture:
    if isinstance(data, str | Path):
        return Reading.of(plan).open(str(data), stored)
    return Reading.of(plan).in_memory(_in_memory(data))


def _in_memory(data: Capture | Sequence[View]) -> Capture:
    if isinstance(data, Capture):
        return data
    views = tuple(view for view in data if isinstance(view, View)) if isinstance(data, Sequence) else ()
    if not views or len(views) < len(data):
        raise InputError(
            f"data is a {type(data).__name__}", expected="a folder, a dataset or a list of views"
        )
    name, count = Counter(view.frame.name for view in views).most_common(1)[0]
    if count > 1:  # trials identify their frames by name
        raise InputError(f"data holds {count} frames named {name!r}", expected="different names")
    return of_views(views, Path("views"))


def _device(scene: Scene, asked: str) -> str:
    """Return the device on which a map computes: that of a map in memory, else the requested one."""
    return str(device_of(scene.field)) if isinstance(scene, Map) else asked


def _name(value: Scene | Data) -> str:
    """Return the name of a map or dataset in results: its folder, or the backend of a map in memory."""
    if isinstance(value, Map):
        return value.info.backend
    if isinstance(value, str | Path):
        return str(value)
    return str(value.path) if isinstance(value, Capture) else "views"


def _named(scenes: Sequence[Scene]) -> dict[str, Scene]:
    """Return the maps by the shortest names that distinguish them; maps in memory with the same backend are numbered."""
    folders = [str(scene) for scene in scenes if not isinstance(scene, Map)]
    if len({Path(folder).resolve() for folder in folders}) != len(folders):
        raise InputError(f"{', '.join(folders)}: one is named twice", where="maps", expected="different ones")
    labels = iter(map_labels(folders))
    found: dict[str, Scene] = {}
    for scene in scenes:
        name = base = _name(scene) if isinstance(scene, Map) else next(labels)
        number = 1
        while name in found:
            number += 1
            name = f"{base} {number}"
        found[name] = scene
    return found


def _sizes(given: Sequence[float | Sequence[float]] | None) -> tuple[Size, ...] | None:
    if given is None:
        return None
    try:
        return tuple(
            tuple(map(float, size)) if isinstance(size, Sequence) else (float(size),) for size in given
        )
    except (TypeError, ValueError) as error:
        raise InputError(
            f"sizes is {given!r}", expected="a list of numbers or of lists of numbers"
        ) from error


def _config(method: str, config: Any) -> str:
    """Return the JSON of the settings that differ from the method's defaults."""
    if config is None or isinstance(config, Mapping):
        config = settings_of(method, dict(config or {}))
    return changed_settings(method, config)
