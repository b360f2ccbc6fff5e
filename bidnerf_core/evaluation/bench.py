"""Many trials: planned from a protocol, run by any executor, and each stored as soon as it is done."""

from __future__ import annotations

import json
import logging
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from dataclasses import dataclass
from typing import Any

from bidnerf_core.datasets import Capture, in_other_split
from bidnerf_core.errors import InputError, InputWarning, amount
from bidnerf_core.evaluation.arcs import arc
from bidnerf_core.evaluation.faults import NO_FAULT, check_depth, expand_faults
from bidnerf_core.evaluation.protocols import MOST_TRIALS, Size, find_protocol
from bidnerf_core.evaluation.results import ResultsFile, key_of
from bidnerf_core.evaluation.summary import succeeded
from bidnerf_core.evaluation.trial import Trial, TrialResult
from bidnerf_core.evaluation.trials import (
    Opened,
    input_digests,
    opened_for,
    opened_points,
    parse_settings,
    registered_for,
    run_trial,
    trial_views,
)
from bidnerf_core.frames import INVERTED, HiddenColour
from bidnerf_core.io import to_plain
from bidnerf_core.localization import find_method, require_use_of_depth
from bidnerf_core.progress import Cancel, Progress, ProgressCallback
from bidnerf_core.scenes import ClosedFormData
from bidnerf_core.settings import Range, WholeNumbers, to_flat

log = logging.getLogger("bidnerf")

CHANGED = {
    "views": "images, depth, masks or cameras than {trial.data} has now",
    "points": "depth points than {trial.depth_points} has now",
    "surface": "surface than map {trial.map} has now, which was rebaked",
}
"""Meaning of a change in each digest of a trial's input, by the digest's name."""
LIMITS: dict[str, Range] = {
    "trials": WholeNumbers(1, MOST_TRIALS),
    "seed": WholeNumbers(0, 2**31 - 1),
    "images": WholeNumbers(1, 1000),
    "angle": Range(0.01, 360.0),
}


@dataclass(frozen=True)
class Plan:
    """A set of trials to run. None selects the protocol's own sizes, number of trials and seed.

    Raises ``InputError`` for an unknown protocol or fault, and for numbers that are invalid for any map and
    dataset.
    """

    map: str  # folder, demo:NAME, or a name for a map in memory
    data: str
    protocol: str = "bid"
    sizes: tuple[Size, ...] | None = None
    method: str = "auto"
    config: str = "{}"  # JSON, see Trial
    trials: int | None = None  # of each size
    seed: int | None = None
    split: str = "test"
    frames: tuple[str, ...] | None = None  # use only these
    images: int = 1  # length of the sequence around the object that is localized jointly
    angle: float = 15.0  # degrees between neighbours of a sequence
    device: str = "cpu"
    depth: bool = True  # whether the method receives the measured depth
    depth_points: str | None = None  # see Trial
    masks: str | None = None  # see Trial
    mask_hides: HiddenColour = "black"
    faults: tuple[str, ...] = (
        NO_FAULT,
    )  # see Trial; each is applied to the same frames from the same starts
    camera: str | None = None  # see Trial, as the next two
    register_depth: bool | str | None = None
    depth_unit: float | None = None

    def __post_init__(self) -> None:
        protocol = find_protocol(self.protocol)
        for size in self.sizes or ():
            protocol.check_size(size)
        for name, allowed in LIMITS.items():
            value = getattr(self, name)
            if value is not None and (value not in allowed or (name != "angle" and type(value) is not int)):
                raise InputError(f"{name} is {value}", expected=allowed)
        twice = [name for name, count in Counter(self.frames or ()).items() if count > 1]
        if twice:
            raise InputError(f"frames names {twice[0]} more than once", expected="each once")
        object.__setattr__(self, "faults", expand_faults(self.faults) or (NO_FAULT,))


def planned(plan: Plan, dataset: Capture | None = None) -> list[Trial]:
    """Return all trials in the order of the results. Raises ``InputError`` for a plan that cannot be carried
    out.

    ``dataset`` is the one named by the plan; by default it is opened, and the map with it.
    """
    dataset = dataset or opened_for(plan)[1]
    protocol = find_protocol(plan.protocol)
    parse_settings(plan.method, plan.config)
    names = dataset.frame_names(plan.split)
    rigs = _rigs(plan, dataset, names)
    check_depth(plan.faults, plan.depth)
    sizes = protocol.sizes if plan.sizes is None else plan.sizes
    if protocol.fixed and (plan.frames is not None or len(rigs) < len(names)):
        raise InputError(
            f"protocol {plan.protocol!r} defines its own frames", expected="one image and all frames"
        )
    count = protocol.trials if plan.trials is None else plan.trials
    cases = protocol.cases(len(rigs), count, protocol.seed if plan.seed is None else plan.seed)
    if plan.trials is not None and len(cases) < plan.trials:
        log.info(
            f"{amount(len(cases), 'trial')}, one per frame, instead of {plan.trials}: without a start,"
            " repeating a frame gives no new information"
        )
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
            masks=plan.masks,
            mask_hides=plan.mask_hides,
            fault=fault,
            camera=plan.camera,
            register_depth=plan.register_depth,
            depth_unit=plan.depth_unit,
        )
        for fault in plan.faults
        for size in sizes
        for place, seed in cases
    ]


def changed_settings(method: str, settings: Any) -> str:
    """Return the JSON of the settings that differ from the method's defaults."""
    usual, given = to_flat(find_method(method).config_type()), to_flat(settings)
    return json.dumps({k: v for k, v in given.items() if v != usual[k]}, sort_keys=True)


def left_to_do(trials: Sequence[Trial], file: ResultsFile, scene: Opened | None = None) -> list[Trial]:
    """Return the trials without results in the file. ``scene`` is their map and data, by default those they
    name.

    Raises ``InputError`` if it holds a result from another training run or surface of the map, other images
    or other settings.
    """
    _check_same([trial for trial in trials if key_of(trial) in file.results], file, scene)
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
    progress: ProgressCallback | None = None,
    cancel: Cancel | None = None,
    scene: Opened | None = None,
) -> None:
    """Run the trials without results in ``file``, and store each result as soon as it is available.

    At most ``at_once`` trials run concurrently, so that a kill loses little. No trial begins once ``cancel``
    returns True. A trial that fails ends the run with its error, after the results of the running trials have
    been stored. ``scene`` is the map and data of all trials, for an executor in this process; by default
    those they name.
    """
    todo = left_to_do(trials, file, scene)
    waiting, under_way = iter(todo), set[Future[TrialResult]]()
    failed: BaseException | None = None
    count = right = 0
    while True:
        while len(under_way) < at_once and failed is None and not (cancel and cancel()):
            trial = next(waiting, None)
            if trial is None:
                break
            under_way.add(executor.submit(run_trial, trial, scene, registered_for(trial)))
        if not under_way:
            break
        done, under_way = wait(under_way, return_when=FIRST_COMPLETED)
        for future in done:
            error = future.exception()
            if error is not None:
                failed = failed or error
                continue
            file.add(future.result())
            count, right = count + 1, right + succeeded(future.result())
            if progress is not None:
                text = f"{right} within 5 deg and 0.05"
                progress(Progress("trials", count, len(todo), "trials", text))
    if failed is not None:
        raise failed


def shard_of(trials: Sequence[Trial], number: int, shards: int) -> list[Trial]:
    """Return part ``number`` of ``shards``, for one of several machines: every ``shards``-th trial."""
    if not 0 <= number < shards:
        raise InputError(f"shard is {number}", expected=f"0 to {shards - 1}")
    return list(trials[number::shards])


def _check_same(trials: Sequence[Trial], file: ResultsFile, scene: Opened | None) -> None:
    """Raise ``InputError`` if a result in ``file`` came from other weights, settings or input than its trial has now."""
    digests: dict[Any, dict[str, Any]] = {}
    for trial in trials:
        known = file.results[key_of(trial)]
        stored, dataset = scene or opened_for(trial)
        advice = "name another --out, or remove the file to start again"
        if known.weights != stored.training:
            raise InputError(
                f"holds results of another training run of map {trial.map} ({known.weights}, expected"
                f" {stored.training}); {advice}",
                where=file.path,
            )
        _check_settings(trial, known, f"{file.path}: was made with {{}} {{}}, expected {{}}; {advice}")
        if known.inputs is None:  # not recorded by an earlier version
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
                    f"holds results of frame {trial.frame} made with other {what}; {advice}", where=file.path
                )


def _check_settings(trial: Trial, known: TrialResult, message: str) -> None:
    """Raise ``InputError`` if a result was made with other settings; settings unknown to earlier versions had
    their defaults.
    """
    usual = to_flat(find_method(trial.method).config_type())
    for name, value in to_flat(parse_settings(trial.method, trial.config)).items():
        before = known.settings.get(name, usual[name])
        if before != value:
            raise InputError(message.format(name, before, value))


def _rigs(plan: Plan, dataset: Capture, names: list[str]) -> list[tuple[str, ...]]:
    """Return the names of the views for each frame that may be tried."""
    for name in plan.frames or ():
        if name not in names:
            others = {split: dataset.frame_names(split) for split in dataset.splits}
            elsewhere = in_other_split(name, others) or f"no frame {name!r}"
            raise InputError(f"split {plan.split!r}: {elsewhere}", where=plan.data)
    kept = names if plan.frames is None else [name for name in names if name in plan.frames]
    kept = _visible(plan, dataset, kept)
    if plan.images == 1:
        return [(name,) for name in kept]
    if isinstance(dataset, ClosedFormData):
        return [dataset.sequence(name, plan.images, plan.angle) for name in kept]
    rigs = list(_found_sequences(plan, dataset, kept))
    if not rigs:
        raise InputError(
            f"no frame of split {plan.split!r} ends a sequence of {plan.images} frames {plan.angle:g}"
            " degrees apart around what the cameras look at",
            where=plan.data,
        )
    return rigs


def _visible(plan: Plan, dataset: Capture, kept: list[str]) -> list[str]:
    """Return the frames of which masks leave something visible, with a warning that names the others."""
    every = set(dataset.wholly_hidden(plan.split))
    hidden = [name for name in kept if name in every]
    if hidden:
        listed = ", ".join(hidden[:4]) + (", ..." if len(hidden) > 4 else "")
        text = f"masks hide {amount(len(hidden), 'whole frame')} of {len(kept)}, not tried: {listed}"
        if len(hidden) == len(kept):
            raise InputError(f"{text}; {INVERTED}", where=plan.masks or plan.data)
        warnings.warn(f"{plan.masks or plan.data}: {text}", InputWarning, stacklevel=2)
    return [name for name in kept if name not in every]


def check_points(plan: Plan, trials: Sequence[Trial], scene: Opened) -> None:
    """Raise ``InputError`` if the method does not use the plan's depth points, or if the views of some trial observe none."""
    if plan.depth_points is None:
        return
    require_use_of_depth(plan.method)
    points, rigs = opened_points(plan.depth_points, scene[0]), dict.fromkeys(t.frames for t in trials)
    blind = [rig[-1] for rig in rigs if not any(len(points.seen(name, plan.split)) for name in rig)]
    if blind:
        listed = ", ".join(blind[:4]) + (", ..." if len(blind) > 4 else "")
        raise InputError(
            f"has no points for {len(blind)} of {len(rigs)} frames ({listed}); choose others with --frame",
            where=plan.depth_points,
        )


def _found_sequences(plan: Plan, dataset: Capture, kept: list[str]) -> Iterator[tuple[str, ...]]:
    poses = {view.frame.name: view.T_ref_camera for view in dataset.views(plan.split)}
    names = list(poses)  # without those that masks hide altogether
    for name in kept:
        places = (
            arc(list(poses.values()), names.index(name), plan.images, plan.angle) if name in poses else None
        )
        if places is not None:
            yield tuple(names[place] for place in places)
