"""Evaluation: many localizations in one map as a table, run in this process, in worker processes, or on a cluster."""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import replace
from multiprocessing import connection, get_context, parent_process
from pathlib import Path
from typing import Any, TypeAlias

import torch

from bidnerf.evaluation.faults import NO_FAULT
from bidnerf.evaluation.plan import Plan, Trial, list_trials
from bidnerf.evaluation.results import ResultsFile, ResultTable, note_run, provenance, script_command
from bidnerf.evaluation.summary import is_right
from bidnerf.evaluation.trial import (
    InputDigests,
    MapSource,
    Scene,
    TrialResult,
    open_scene,
    registered_for,
    run_trial,
    trial_views,
    views_digest,
)
from bidnerf_core.datasets import Capture
from bidnerf_core.errors import Cancelled, InputError, amount
from bidnerf_core.fields import device_of
from bidnerf_core.installation import import_extra
from bidnerf_core.io import usable_cores
from bidnerf_core.localization import find_method
from bidnerf_core.maps import Map, ViewSource
from bidnerf_core.progress import (
    Cancel,
    Progress,
    ProgressCallback,
    check_cancelled,
    job_context,
    log,
    report_progress,
)
from bidnerf_core.settings import to_flat

Workers: TypeAlias = int | str | None
"""A number of processes, None for one per core, or the address of a dask scheduler such as ``tcp://host:8786``."""
PATIENCE = "20s"
"""Time to wait for the scheduler of a cluster to respond."""
CHANGED = {
    "views": "images, depth, masks or cameras than {trial.data} has now",
    "surface": "surface than map {trial.map} has now, which was rebaked",
}
"""The meaning of a change in a digest of a trial's input, by the name of the digest."""


def evaluate(
    scene: MapSource,
    data: ViewSource,
    plan: Plan | None = None,
    *,
    out: str | Path | None = None,
    workers: Workers = 1,
    progress: ProgressCallback | None = None,
    cancel: Cancel | None = None,
) -> ResultTable:
    """Localize many frames of ``data`` in a map, with the starts of a protocol or without starts, and return all results.

    ``out`` is a results file: trials already in it are not run again, and each result is on disk before the
    next trial begins, so that the same call resumes an evaluation that was interrupted or cancelled. The
    command of the running program is recorded next to it as the origin of the results. ``workers`` is the
    number of processes (None: one per core, or a single one on a GPU), or the address of a dask scheduler. More
    than one process requires a map and data in folders and an importable main module, and names registered at
    run time are found only if importing that module registers them. With one process, everything runs in the
    calling thread.

    Raises ``InputError`` for an evaluation that cannot be carried out, and ``Cancelled`` once ``cancel`` returns True
    and the running trials have ended.
    """
    in_memory = isinstance(scene, Map) or not isinstance(data, str | Path)
    if in_memory and workers not in (1, None):
        raise InputError(
            f"workers is {workers}",
            expected="1: other processes read the map and the data from folders, and these are in memory",
        )
    plan = plan or Plan()
    with job_context(progress, cancel):
        here = open_scene(scene, data, plan)
        names = scene.info.backend if isinstance(scene, Map) else str(scene), data_name(data, here[1])
        device = device_name(scene, plan.device)
        trials = [replace(trial, device=device) for trial in list_trials(plan, *names, here[1])]
        with ResultsFile(None if out is None else Path(out)) as file:
            run_trials(trials, file, here, 1 if in_memory else workers)
            file.put_in_order(trials)
            return ResultTable(tuple(file[trial] for trial in trials))


def data_name(data: ViewSource, dataset: Capture) -> str:
    """Return the name of a dataset in results: its folder as given, or the path of a dataset in memory."""
    return str(data if isinstance(data, str | Path) else dataset.path)


def device_name(source: MapSource, usual: str) -> str:
    """Return the device of a map in memory, or ``usual`` for any other map."""
    return str(device_of(source.field)) if isinstance(source, Map) else usual


def run_trials(
    trials: Sequence[Trial],
    file: ResultsFile,
    scene: Scene | None = None,
    workers: Workers = 1,
) -> None:
    """Run the trials that have no result in ``file``, and store each result as soon as it is available.

    At most as many trials run concurrently as there are workers, so that little is lost if the process is
    killed. No trial begins once the job is cancelled. A trial that fails ends the run with its error, after
    the results of the other running trials have been stored. ``scene`` is the map and data of all trials, by
    default those that the trials name; other processes read them from folders. Raises ``InputError`` as
    ``missing_trials`` does, and ``Cancelled``.
    """
    todo = missing_trials(trials, file, scene)
    if len(todo) < len(trials):
        log.info("%s: %d of %d trials are already there", file.path, len(trials) - len(todo), len(trials))
    if not todo:
        return
    where = "" if file.path is None else f" in {file.path}"
    with executor_of(workers, len(todo), todo[0].device == "cpu") as (executor, at_once, description):
        if file.path is not None:
            note_run(file.path, provenance(script_command(), description))
        try:
            _run(todo, file, executor, at_once, scene if at_once == 1 else None)
        except BrokenProcessPool as error:
            raise InputError(
                f"a worker process died (is there enough memory for {at_once} of them, and does the main module"
                f" begin work only under 'if __name__ == \"__main__\"'?); finished trials are kept{where}, the same"
                " command resumes"
            ) from error
        except Cancelled as error:
            left = sum(trial not in file for trial in trials)
            advice = "nothing is stored without a results file" if file.path is None else "the same command resumes"
            raise Cancelled(
                f"stopped; {amount(left, 'trial')} {'is' if left == 1 else 'are'} left{where}, {advice}"
            ) from error


def _run(todo: Sequence[Trial], file: ResultsFile, executor: Executor, at_once: int, scene: Scene | None) -> None:
    """Run trials, ``at_once`` at a time, and store their results; raise the first error once the running ones have ended."""
    running = set[Future[TrialResult]]()
    count = right = 0

    def store_finished() -> None:
        nonlocal count, right
        for future in wait(running, return_when=FIRST_COMPLETED).done:
            running.remove(future)
            file.add(future.result())
            count, right = count + 1, right + is_right(future.result())
            text = f"{right} within 5 deg and 0.05"
            report_progress(Progress("trials", count, len(todo), "trials", text))

    try:
        for trial in todo:
            check_cancelled("trials")
            running.add(executor.submit(run_trial, trial, scene, registered_for(trial)))
            if len(running) == at_once:
                store_finished()
        while running:
            store_finished()
    except Exception:
        for future in wait(running).done:
            if future.exception() is None:
                file.add(future.result())
        raise


def missing_trials(trials: Sequence[Trial], file: ResultsFile, scene: Scene | None = None) -> list[Trial]:
    """Return the trials that have no result in the file.

    ``scene`` is the map and data of the trials, by default those that the trials name. Raises ``InputError`` if
    the file holds a result from another training run or surface of the map, other images or other settings.
    Settings unknown to the version that made a result are assumed to have had their defaults.
    """
    digests = dict[Any, InputDigests]()
    advice = "name another file (`out`), or remove the file to start again"
    for trial in (trial for trial in trials if trial in file):
        result = file[trial]
        stored, dataset = scene or open_scene(trial.map, trial.data, trial)
        if result.weights != stored.training:
            raise InputError(
                f"holds results of another training run of map {trial.map} ({result.weights}, expected"
                f" {stored.training}); {advice}",
                where=file.path,
            )
        usual = to_flat(find_method(trial.method).config_type())
        for name, value in (usual | json.loads(trial.config)).items():
            before = result.settings.get(name, usual.get(name))
            if before != value:
                raise InputError(f"was made with {name} {before}, expected {value}; {advice}", where=file.path)
        # The images depend on the seed only if they have faults.
        seed = None if trial.fault == NO_FAULT else trial.seed
        read = trial.frames, trial.depth, trial.fault, seed
        if read not in digests:
            digests[read] = InputDigests(views_digest(trial_views(trial, dataset)), stored.info.surface)
        for name, meaning in CHANGED.items():
            if getattr(result.inputs, name) != getattr(digests[read], name):
                raise InputError(
                    f"holds results of frame {trial.frame} made with other {meaning.format(trial=trial)}; {advice}",
                    where=file.path,
                )
    return [trial for trial in trials if trial not in file]


# Executors.


class InThisProcess(Executor):
    """An executor that runs every call immediately, in this process.

    Calls do not report progress to the current job and are not stopped with it: cancelling ends an evaluation
    between trials.
    """

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        try:
            with job_context(lambda progress: None, lambda: False):
                future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


def local_processes(count: int) -> ProcessPoolExecutor:
    """Return an executor of ``count`` single-threaded processes, which end when this process ends, for whatever reason."""
    return ProcessPoolExecutor(count, mp_context=get_context("spawn"), initializer=_prepare_worker)


def _prepare_worker() -> None:
    """Set up a worker process to ignore Ctrl-C, use one thread, and exit when its parent is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    torch.set_num_threads(1)
    parent = parent_process()

    def follow() -> None:
        if parent is not None:
            connection.wait([parent.sentinel])
            os._exit(1)

    threading.Thread(target=follow, daemon=True).start()


@contextmanager
def executor_of(workers: Workers, trials: int, on_cpu: bool) -> Iterator[tuple[Executor, int, str]]:
    """Yield an executor for ``trials`` trials, the number of trials to run on it at once, and its description.

    If the work fails, the local processes are ended along with their trials. Workers of a cluster need this
    package, the same backends, and the maps and data under the same paths. Peak memory is measured per process,
    and therefore per trial only if each worker has one thread (``dask worker --nthreads 1``).

    Raises ``InputError`` for a number below 1, if dask is missing, and if no scheduler or worker responds.
    """
    if isinstance(workers, str):
        distributed = import_extra("distributed", "cluster", "a cluster")
        try:
            client = distributed.Client(workers, timeout=PATIENCE, set_as_default=False)
        except (OSError, ValueError) as error:  # TimeoutError is an OSError
            raise InputError(
                f"no dask scheduler at {workers} ({error})", expected="one such as tcp://host:8786"
            ) from error
        with client:
            threads = sum(client.nthreads().values())
            if threads == 0:
                raise InputError(f"the dask scheduler at {workers} has no workers", expected="at least one")
            yield client.get_executor(pure=False), 2 * threads, f"dask, {threads} threads"
        return
    if workers is not None and workers < 1:
        raise InputError(f"workers is {workers}", expected="1 or more, or None for one per core")
    count = min(workers or (usable_cores() if on_cpu else 1), trials)
    with terminate_on_failure(InThisProcess() if count == 1 else local_processes(count)) as executor:
        yield executor, count, f"{count} local process{'es' if count > 1 else ''} of one thread"


@contextmanager
def cluster(workers: Workers) -> Iterator[None]:
    """Let ``train`` and ``find_poses`` work in other processes within the block; the results are the same.

    These detect and match keypoints, and train the cells of the backend ``cells``.

    ``workers`` is a number of local processes (None: one per core), or the address of a dask scheduler, which repeats the tasks of a
    worker that is lost. Raises ``InputError`` as ``evaluate`` does.
    """
    with executor_of(workers, sys.maxsize, True) as (executor, *_), job_context(executor=executor):
        yield


@contextmanager
def terminate_on_failure(executor: Executor) -> Iterator[Executor]:
    """Yield an executor, which is shut down afterwards; if the block fails, the executor's processes are terminated."""
    try:
        yield executor
    except BaseException:
        for process in (getattr(executor, "_processes", None) or {}).values():
            process.terminate()
        raise
    finally:
        executor.shutdown(cancel_futures=True)
