"""Many trials: planned from a protocol, run by any executor, and each stored as soon as it is done."""

from __future__ import annotations

import json
import os
import threading
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ProcessPoolExecutor, wait
from dataclasses import dataclass
from multiprocessing import connection, get_context, parent_process
from typing import Any

import torch

from bidnerf_core.datasets import Dataset
from bidnerf_core.errors import InputError
from bidnerf_core.evaluation.faults import NO_FAULT, check_depth
from bidnerf_core.evaluation.protocols import Size, find_protocol
from bidnerf_core.evaluation.results import ResultsFile, key_of
from bidnerf_core.evaluation.trial import Trial, TrialResult
from bidnerf_core.evaluation.trials import (
    input_digests,
    opened,
    opened_points,
    parse_settings,
    run_trial,
    trial_views,
)
from bidnerf_core.geometry.arcs import arc
from bidnerf_core.io.json import to_plain
from bidnerf_core.localization import find_method
from bidnerf_core.localization.methods import RENAMED, require_use_of_depth
from bidnerf_core.scenes.closed_form_data import ClosedFormData
from bidnerf_core.settings import to_flat

CHANGED = {
    "views": "images, depth or cameras than {trial.data} has now",
    "points": "depth points than {trial.depth_points} has now",
    "surface": "surface than map {trial.map} has now, which was baked anew",
}
"""The meaning of a change in each digest of a trial's input, by the digest's name."""


@dataclass(frozen=True)
class Plan:
    """A set of trials to run. None selects the protocol's own sizes, number of trials and seed."""

    map: str
    data: str
    protocol: str = "bid"
    sizes: tuple[Size, ...] | None = None
    method: str = "auto"
    config: str = "{}"  # JSON, see Trial
    trials: int | None = None  # of each size
    seed: int | None = None
    split: str = "test"
    frames: tuple[str, ...] | None = None  # try these only
    images: int = 1  # length of the sequence around the object that is localized at once
    angle: float = 15.0  # degrees between neighbours of a sequence
    device: str = "cpu"
    depth: bool = True  # whether the method gets the measured depth
    depth_points: str | None = None  # see Trial
    faults: tuple[str, ...] = (NO_FAULT,)  # see Trial; each is tried on the same frames from the same starts


def planned(plan: Plan) -> list[Trial]:
    """Return all trials in the order of the results. Raises ``InputError`` for a plan that cannot be carried out."""
    _, dataset = opened(plan.map, plan.data, plan.device)
    protocol = find_protocol(plan.protocol)
    parse_settings(plan.method, plan.config)
    names = dataset.frame_names(plan.split)
    rigs = _rigs(plan, dataset, names)
    _check_points(plan, rigs)
    check_depth(plan.faults, plan.depth)
    sizes = protocol.sizes if plan.sizes is None else plan.sizes
    for size in sizes:
        protocol.check_size(size)
    if protocol.fixed and (plan.frames is not None or len(rigs) < len(names)):
        raise InputError(f"protocol {plan.protocol!r} has its own frames, expected one image and all frames")
    count = protocol.trials if plan.trials is None else plan.trials
    cases = protocol.cases(len(rigs), count, protocol.seed if plan.seed is None else plan.seed)
    return [
        Trial(
            map=plan.map,
            data=plan.data,
            frames=rigs[place],
            protocol=plan.protocol,
            size=size,
            method=plan.method,
            config=plan.config,
            seed=seed,
            split=plan.split,
            device=plan.device,
            depth=plan.depth,
            depth_points=plan.depth_points,
            fault=fault,
        )
        for fault in plan.faults
        for size in sizes
        for place, seed in cases
    ]


def changed_settings(method: str, settings: Any) -> str:
    """Return the JSON of the settings that differ from the method's defaults."""
    usual, given = to_flat(find_method(method).config_type()), to_flat(settings)
    return json.dumps({k: v for k, v in given.items() if v != usual[k]}, sort_keys=True)


def left_to_do(trials: Sequence[Trial], file: ResultsFile) -> list[Trial]:
    """Return the trials whose results are not in the file.

    Raises ``InputError`` where it holds a result from another training or surface of the map, other images or other settings.
    """
    _check_same([trial for trial in trials if key_of(trial) in file.results], file)
    return [trial for trial in trials if key_of(trial) not in file.results]


def repeated_frames(trials: Sequence[Trial]) -> str | None:
    """Return a sentence about frames that are tried several times at each size, or None if there are none."""
    times = Counter((trial.fault, trial.size, trial.frames) for trial in trials)
    if not times or max(times.values()) == 1:
        return None
    frames = len({frames for _, _, frames in times})
    fewest, most = min(times.values()), max(times.values())
    often = f"{most}" if fewest == most else f"{fewest} to {most}"
    a_size = " of each size" if len({size for _, size, _ in times}) > 1 else ""
    distinct = f"{frames} distinct frame{'s' if frames > 1 else ''}"
    return f"{distinct} of split {trials[0].split!r}, each tried {often} times{a_size} with different seeds"


def run_trials(
    trials: Sequence[Trial],
    file: ResultsFile,
    executor: Executor,
    at_once: int,
    finished: Callable[[TrialResult], None] = lambda result: None,
    stopping: Callable[[], bool] = lambda: False,
) -> None:
    """Run the trials whose results ``file`` does not hold, and store each result when it is done.

    At most ``at_once`` trials are under way at once, so that a kill loses little. No trial begins once ``stopping``
    returns True. A trial that fails ends the run with its error, after the results of the trials under way have been stored.
    """
    waiting, under_way = iter(left_to_do(trials, file)), set[Future[TrialResult]]()
    failed: BaseException | None = None
    while True:
        while len(under_way) < at_once and failed is None and not stopping():
            trial = next(waiting, None)
            if trial is None:
                break
            under_way.add(executor.submit(run_in_worker, trial))
        if not under_way:
            break
        done, under_way = wait(under_way, return_when=FIRST_COMPLETED)
        for future in done:
            error = future.exception()
            if error is not None:
                failed = failed or error
                continue
            file.add(future.result())
            finished(future.result())
    if failed is not None:
        raise failed


def shard_of(trials: Sequence[Trial], number: int, shards: int) -> list[Trial]:
    """Return part ``number`` of ``shards``, for one machine among several: every ``shards``-th trial."""
    if not 0 <= number < shards:
        raise InputError(f"shard is {number}, expected 0 to {shards - 1}")
    return list(trials[number::shards])


def run_in_worker(trial: Trial) -> TrialResult:
    """Run a trial on one thread, in a process that runs nothing else."""
    torch.set_num_threads(1)
    return run_trial(trial)


class InThisProcess(Executor):
    """An executor that runs every call immediately, in this process."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


def local_processes(count: int) -> Executor:
    """Return an executor of ``count`` processes of one thread each, which end when this process ends, for whatever reason."""
    if count == 1:
        return InThisProcess()
    return ProcessPoolExecutor(count, mp_context=get_context("spawn"), initializer=prepare_worker)


def prepare_worker() -> None:
    """Set up a worker: it leaves Ctrl-C to its parent and exits when its parent is gone."""
    import signal

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    torch.set_num_threads(1)
    threading.Thread(target=_follow_parent, daemon=True).start()


def _follow_parent() -> None:
    parent = parent_process()
    if parent is not None:
        connection.wait([parent.sentinel])
        os._exit(1)


def _check_same(trials: Sequence[Trial], file: ResultsFile) -> None:
    """Raise ``InputError`` where a result in ``file`` came from other weights, settings or input than its trial has now."""
    digests: dict[Any, dict[str, Any]] = {}
    for trial in trials:
        known = file.results[key_of(trial)]
        stored, dataset = opened(trial.map, trial.data, trial.device)
        advice = "name another --out, or remove the file to begin anew"
        if known.weights != stored.info.weights:
            raise InputError(
                f"{file.path}: holds results of another training of map {trial.map} "
                f"({known.weights}, expected {stored.info.weights}); {advice}"
            )
        _check_settings(trial, known, f"{file.path}: was made with {{}} {{}}, expected {{}}; {advice}")
        if known.inputs is None:  # an earlier version did not record it
            continue
        seed = (
            None if trial.fault == NO_FAULT else trial.seed
        )  # the images depend on the seed only if they have faults
        read = trial.frames, trial.depth, trial.depth_points, trial.fault, seed
        if read not in digests:
            digests[read] = to_plain(input_digests(trial, stored, trial_views(trial, dataset)))
        for name, digest in to_plain(known.inputs).items():
            if digest != digests[read][name]:
                what = CHANGED[name].format(trial=trial)
                raise InputError(
                    f"{file.path}: holds results of frame {trial.frame} made with other {what}; {advice}"
                )


def _check_settings(trial: Trial, known: TrialResult, message: str) -> None:
    """Raise ``InputError`` if a result was made with other settings; those that earlier versions lacked had their defaults."""
    usual = to_flat(find_method(trial.method).config_type())
    found = {RENAMED.get(name, name): value for name, value in known.settings.items()}
    for name, value in to_flat(parse_settings(trial.method, trial.config)).items():
        before = found.get(name, usual[name])
        if before != value:
            raise InputError(message.format(name, before, value))


def _rigs(plan: Plan, dataset: Dataset, names: list[str]) -> list[tuple[str, ...]]:
    """Return, for each frame that may be tried, the names of its views."""
    for name in plan.frames or ():
        if name not in names:
            raise InputError(f"{plan.data}: split {plan.split!r} has no frame {name!r}")
    kept = names if plan.frames is None else [name for name in names if name in plan.frames]
    if plan.images == 1:
        return [(name,) for name in kept]
    if isinstance(dataset, ClosedFormData):
        return [dataset.sequence(name, plan.images, plan.angle) for name in kept]
    rigs = list(_found_sequences(plan, dataset, names, kept))
    if not rigs:
        raise InputError(
            f"{plan.data}: no frame of split {plan.split!r} ends a sequence of {plan.images} frames "
            f"{plan.angle:g} degrees apart around what the cameras look at"
        )
    return rigs


def _check_points(plan: Plan, rigs: list[tuple[str, ...]]) -> None:
    """Raise ``InputError`` if the method does not use depth points, or if the views of some frame observe none."""
    points = opened_points(plan.depth_points, plan.map)
    if points is None:
        return
    require_use_of_depth(plan.method)
    blind = [rig[-1] for rig in rigs if not any(len(points.seen(name, plan.split)) for name in rig)]
    if blind:
        listed = ", ".join(blind[:4]) + (", ..." if len(blind) > 4 else "")
        raise InputError(
            f"{plan.depth_points}: has no points for {len(blind)} of {len(rigs)} frames ({listed}); "
            "choose others with --frame"
        )


def _found_sequences(
    plan: Plan, dataset: Dataset, names: list[str], kept: list[str]
) -> Iterator[tuple[str, ...]]:
    poses = [view.T_ref_camera for view in dataset.views(plan.split)]
    for name in kept:
        places = arc(poses, names.index(name), plan.images, plan.angle)
        if places is not None:
            yield tuple(names[place] for place in places)
