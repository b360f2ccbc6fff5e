"""``bidnerf evaluate``."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Iterator
from concurrent.futures import Executor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import tyro

from bidnerf_core.cli.method_options import Preset, chosen_settings
from bidnerf_core.cli.options import (
    LARGEST_SEED,
    Device,
    Names,
    option,
    parse,
    require,
    require_different,
    wrong_usage,
)
from bidnerf_core.cli.output import say, show
from bidnerf_core.cli.trial_progress import TrialProgress
from bidnerf_core.errors import InputError, UsageError, amount
from bidnerf_core.evaluation.bench import (
    Plan,
    changed_settings,
    left_to_do,
    local_processes,
    planned,
    repeated_frames,
    run_trials,
    shard_of,
)
from bidnerf_core.evaluation.cluster import dask_executor
from bidnerf_core.evaluation.faults import FAULTS, NO_FAULT, expand_faults
from bidnerf_core.evaluation.protocols import MOST_TRIALS, PROTOCOLS, Size, find_protocol
from bidnerf_core.evaluation.provenance import command_line, note_run, provenance
from bidnerf_core.evaluation.results import ResultsFile, key_of
from bidnerf_core.evaluation.trial import Trial
from bidnerf_core.localization import METHODS
from bidnerf_core.localization.methods import USUAL_METHOD

Place = Annotated[str, tyro.conf.Positional]


def run(arguments: list[str]) -> None:
    """Run the command; its options include the settings of the method that the arguments name."""
    settings = chosen_settings(arguments, USUAL_METHOD)

    def evaluate(
        map: Annotated[Place, option("MAP", "folder of a map, or demo:blobs")],
        data: Annotated[
            str | None,
            tyro.conf.Positional,
            option("[DATA]", "folder of a dataset, or demo:object, demo:room, demo:blobs", ""),
        ] = None,
        *,
        out: Annotated[
            Path, option("RESULTS.jsonl", "file of results; trials that it already holds are not run again")
        ],
        protocol: Annotated[str, option("NAME", "how starts are chosen: " + ", ".join(PROTOCOLS))] = "bid",
        size: Annotated[
            tuple[str, ...],
            option("SIZE...", "error of the start: e_t, or METRES:DEGREES for perturb", "the protocol's"),
        ] = (),
        method: Annotated[str, option("NAME", "how poses are found: " + ", ".join(METHODS))] = USUAL_METHOD,
        trials: Annotated[
            int | None, option("N", "number of trials of each size", "the protocol's, 24 or 25")
        ] = None,
        seed: Annotated[int | None, option("S", "seed of every random choice", "the protocol's, 0")] = None,
        split: Annotated[str, option("NAME", "split of the dataset")] = "test",
        frame: Annotated[Names, option("NAME...", "try only these frames", "all of the split")] = (),
        images: Annotated[int, option("K", "localize a sequence of K images around the object at once")] = 1,
        angle: Annotated[float, option("DEGREES", "angle between neighbours of a sequence")] = 15.0,
        depth: Annotated[bool, option(None, "use the measured depth where there is any")] = True,
        depth_points: Annotated[
            Path | None,
            option(
                "MODEL", "COLMAP sparse model whose points, where frames observe them, are used as depth", ""
            ),
        ] = None,
        fault: Annotated[
            Names,
            option(
                "NAME:SIZE...",
                "try every trial with each of these faults of the images; NAME:SIZE,SIZE names several, A:SIZE+B:SIZE both "
                "at once, none the images as they are; names: " + ", ".join(FAULTS),
                "none",
            ),
        ] = (),
        device: Device = "cpu",
        workers: Annotated[
            int | None, option("N", "number of processes, of one thread each", "one a core; one on a GPU")
        ] = None,
        dask: Annotated[
            str | None, option("ADDRESS", "address of a dask scheduler whose workers run the trials", "")
        ] = None,
        shards: Annotated[int, option("N", "number of parts that the trials are split into")] = 1,
        shard: Annotated[int, option("I", "the part to run, from 0")] = 0,
        preset: Preset = None,
        config: Any = None,
    ) -> None:
        """Localize many frames from perturbed starts, or from none, and write one JSON line per trial.

        Finished trials are kept whatever happens: the same command resumes where it stopped. 'bidnerf report' makes tables
        and figures of the results.
        """
        _check(trials, seed, images, angle, workers, shards, shard)
        with wrong_usage():
            chosen = find_protocol(protocol)
            for asked in _sizes(size) or ():
                chosen.check_size(asked)
        names = tuple(name for group in frame for name in group) or None
        require_different("--frame", names or ())
        plan = Plan(
            map, data or _own_data(map), protocol, _sizes(size), method, changed_settings(method, config),
            trials, seed, split, names, images, angle, device, depth,
            None if depth_points is None else str(depth_points), _faults(fault),
        )  # fmt: skip
        trials_of_all = planned(plan)
        if repeated := repeated_frames(trials_of_all):
            say(repeated)
        mine = shard_of(trials_of_all, shard, shards)
        _evaluate(mine, out, workers, dask, command_line("bidnerf evaluate", arguments))

    parse("evaluate", evaluate, arguments, settings)


def _evaluate(trials: list[Trial], out: Path, workers: int | None, dask: str | None, command: str) -> None:
    with ResultsFile(out) as file:
        todo = left_to_do(trials, file)
        _note_unchecked(trials, file, out)
        if len(todo) < len(trials):
            say(f"{out}: {len(trials) - len(todo)} of {len(trials)} trials are already there")
        if todo:
            with _executor(workers, dask, len(todo), todo[0].device == "cpu") as (executor, at_once, what):
                note_run(out, provenance(command, what))
                _run(todo, file, executor, at_once)
        file.put_in_order(trials)
    show(f"{amount(len(trials), 'trial')} in {out}; 'bidnerf report {out}' shows them")


def _note_unchecked(trials: list[Trial], file: ResultsFile, out: Path) -> None:
    """Print how many results cannot be checked against the present images, because an earlier version wrote them."""
    known = [file.results.get(key_of(trial)) for trial in trials]
    count = sum(result is not None and result.inputs is None for result in known)
    if count:
        say(f"{out}: {count} results of an earlier version do not record their images and are kept unchecked")


def _run(todo: list[Trial], file: ResultsFile, executor: Executor, at_once: int) -> None:
    with TrialProgress(len(todo), at_once) as progress:
        try:
            run_trials(todo, file, executor, at_once, progress.done, lambda: progress.stopping)
        except BrokenProcessPool as error:
            raise InputError(
                f"a worker process ended by itself (is there enough memory for {at_once} of them?); "
                f"finished trials are kept in {file.path}, the same command goes on"
            ) from error
    if progress.count < len(todo):
        say(f"stopped; {len(todo) - progress.count} trials are left, the same command goes on")
        raise KeyboardInterrupt


@contextmanager
def _executor(
    workers: int | None, dask: str | None, trials: int, on_cpu: bool
) -> Iterator[tuple[Executor, int, str]]:
    """Yield an executor, the number of trials to run on it at once, and its description."""
    if dask is not None:
        if workers is not None:
            raise UsageError("--workers and --dask contradict each other: a cluster has its own workers")
        with dask_executor(dask) as (executor, threads):
            yield executor, 2 * threads, f"dask, {threads} threads"
        return
    count = min(workers or (cores() if on_cpu else 1), trials)
    executor = local_processes(count)
    try:
        yield executor, count, f"{count} local process{'es' if count > 1 else ''} of one thread"
    except BaseException:
        for process in multiprocessing.active_children():  # their trials are lost anyway
            process.terminate()
        raise
    finally:
        executor.shutdown(cancel_futures=True)


def cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _sizes(given: tuple[str, ...]) -> tuple[Size, ...] | None:
    """Return sizes from words such as 0.5 or 0.2:10; None where none was given."""
    try:
        return tuple(tuple(float(number) for number in size.split(":")) for size in given) or None
    except ValueError as error:
        raise UsageError(f"--size is {' '.join(given)}, expected numbers as 0.5, or 0.2:10") from error


def _faults(given: Names) -> tuple[str, ...]:
    """Return the faults to try; without any given, only images as they are."""
    with wrong_usage():
        return expand_faults(word for group in given for word in group) or (NO_FAULT,)


def _own_data(map: str) -> str:
    if not map.startswith("demo:"):
        raise UsageError(f"no DATA after map {map}; only closed-form maps have data of their own")
    return map


def _check(
    trials: int | None, seed: int | None, images: int, angle: float, workers: int | None, shards: int, shard: int
) -> None:  # fmt: skip
    require("--trials", 1 if trials is None else trials, 1, MOST_TRIALS)
    require("--seed", seed or 0, 0, LARGEST_SEED)
    require("--images", images, 1, 1000)
    require("--angle", angle, 0.01, 360)
    require("--workers", 1 if workers is None else workers, 1, 10_000)
    require("--shards", shards, 1)
    require("--shard", shard, 0, shards - 1)
