"""Executors of trials: this process, other processes on this machine, or the workers of a cluster."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import connection, get_context, parent_process
from types import TracebackType
from typing import Any

import torch

from bidnerf_core.errors import InputError
from bidnerf_core.evaluation.trial import Trial, TrialResult
from bidnerf_core.evaluation.trials import Opened, opened_for, parse_settings, registered_for, run_trial
from bidnerf_core.fields import device_of, levels
from bidnerf_core.frames import View, draw, uniform
from bidnerf_core.geometry import SE3
from bidnerf_core.io import from_plain, parse_json, to_plain
from bidnerf_core.localization import origin_of
from bidnerf_core.settings import to_flat

PATIENCE = "20s"
"""Time to wait for the scheduler of a cluster."""
COUNTED_RAYS = 2048
"""The number of rays on which samples are counted."""


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
    """Return an executor of ``count`` single-threaded processes, which end when this process ends, for
    whatever reason.
    """
    if count == 1:
        return InThisProcess()
    return ProcessPoolExecutor(count, mp_context=get_context("spawn"), initializer=prepare_worker)


def prepare_worker() -> None:
    """Set up a worker: it leaves Ctrl-C to its parent and exits when the parent is gone."""
    import signal

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    torch.set_num_threads(1)
    threading.Thread(target=_follow_parent, daemon=True).start()


def _follow_parent() -> None:
    parent = parent_process()
    if parent is not None:
        connection.wait([parent.sentinel])
        os._exit(1)


def cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def workers_for(
    trials: int, on_cpu: bool, workers: int | None = 1, dask: str | None = None
) -> Iterator[tuple[Executor, int, str]]:
    """Yield an executor for a number of trials, how many of them to run on it at once, and its description.

    ``workers`` is the number of processes; None means one per core, and one on a GPU. ``dask`` is the
    address of a scheduler whose workers run the trials instead. If the work fails, the processes are ended
    with their trials. Raises ``InputError`` for a number below 1, and as ``dask_executor`` does.
    """
    if workers is not None and workers < 1:
        raise InputError(f"workers is {workers}", expected="1 or more, or None for one per core")
    if dask is not None:
        with dask_executor(dask) as (cluster, threads):
            yield cluster, 2 * threads, f"dask, {threads} threads"
        return
    count = min(workers or (cores() if on_cpu else 1), trials)
    executor = local_processes(count)
    try:
        yield executor, count, f"{count} local process{'es' if count > 1 else ''} of one thread"
    except BaseException:
        for process in (getattr(executor, "_processes", None) or {}).values():
            process.terminate()
        raise
    finally:
        executor.shutdown(cancel_futures=True)


@contextmanager
def dask_executor(address: str) -> Iterator[tuple[Executor, int]]:
    """Yield an executor for the dask scheduler at ``address``, and the number of trials that its workers run
    concurrently.

    Workers need this package, the same backends, and the maps and data under the same paths. Peak memory is
    measured per process: it is that of a single trial only if the worker has one thread (``dask worker
    --nthreads 1``).

    Raises ``InputError`` if dask is missing, and if no scheduler or worker responds.
    """
    try:
        from distributed import Client
    except ImportError as error:
        raise InputError("--dask needs dask, which is missing: pip install 'bidnerf[cluster]'") from error
    try:
        client = Client(address, timeout=PATIENCE, set_as_default=False)
    except (OSError, ValueError) as error:  # TimeoutError is an OSError
        raise InputError(
            f"no dask scheduler at {address} ({error})", expected="one such as tcp://host:8786"
        ) from error
    with client:
        threads = sum(client.nthreads().values())
        if threads == 0:
            raise InputError(f"the dask scheduler at {address} has no workers", expected="at least one")
        yield client.get_executor(), threads


@dataclass(frozen=True)
class Measured:
    """The result of a trial, and the mean number of samples per ray in its last frame at the true pose."""

    result: TrialResult
    samples_per_ray: float  # for the field level in the method's settings, else the finest


def measured(
    trial: Trial, scene: Opened | None = None, registered: Sequence[tuple[str, str]] = ()
) -> Measured:
    """Run a trial as ``run_trial`` does, and count samples."""
    return Measured(run_trial(trial, scene, registered), samples_per_ray(trial, scene))


def samples_per_ray(trial: Trial, scene: Opened | None = None) -> float:
    """Return the mean number of valid samples on uniformly drawn rays."""
    stored, dataset = scene or opened_for(trial)
    (view,) = dataset.views(trial.split, trial.frames[-1:])
    number = to_flat(parse_settings(trial.method, trial.config)).get("level")
    level = stored.field if number is None else levels(stored.field)[number]
    own = (View(view.frame, SE3.identity()),)
    device = device_of(stored.field)
    pixels = draw(own, COUNTED_RAYS, uniform, torch.Generator().manual_seed(trial.seed), device=device)
    with torch.no_grad():
        samples = level.sampler(pixels.rays(view.T_ref_camera.translated(-origin_of(stored)), stored.bounds))
    return float(samples.valid.sum()) / COUNTED_RAYS


@dataclass(frozen=True)
class _Question:
    trial: Trial
    registered: list[tuple[str, str]]


class TrialProcess:
    """A process that runs trials one after another and keeps its map in memory, so that its memory and time
    are those of one map.

    It is a new interpreter that exchanges JSON, not a fork: it shares no memory, and scripts need no
    ``__main__`` guard. Use it as a context manager.
    """

    def __init__(self) -> None:
        self._process = subprocess.Popen(
            # With -P, files in the current folder are not mistaken for modules.
            [sys.executable, "-P", "-m", __name__], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
            start_new_session=True,  # so that Ctrl-C reaches only this process, which ends the other
        )  # fmt: skip

    def run(self, trial: Trial) -> Measured:
        """Run a trial. Raises ``InputError`` if it cannot run, or if the process ends before its result."""
        try:
            _send(self._process.stdin, to_plain(_Question(trial, registered_for(trial))))
            line = self._process.stdout.readline() if self._process.stdout else ""
        except BrokenPipeError:
            line = ""
        if not line:
            raise InputError(
                f"the process that localized frame {trial.frame} ended with status {self._process.wait()}",
                where=trial.map,
                expected="a result; was memory short?",
            )
        answer = parse_json(line, trial.map, "a result")
        if "refused" in answer:
            raise InputError(answer["refused"])
        return from_plain(Measured, answer, "result")

    def __enter__(self) -> TrialProcess:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, where: TracebackType | None
    ) -> None:
        self._process.kill()
        self._process.communicate()


def _serve(questions: Iterable[str], answers: Any) -> None:
    """Answer each line with a line, until there are none left."""
    for line in questions:
        asked = from_plain(_Question, parse_json(line, "stdin", "a trial"), "question")
        try:
            _send(answers, to_plain(measured(asked.trial, registered=asked.registered)))
        except InputError as error:
            _send(answers, {"refused": str(error)})


def _send(stream: Any, value: dict[str, Any]) -> None:
    stream.write(json.dumps(value, allow_nan=False) + "\n")
    stream.flush()


if __name__ == "__main__":
    with os.fdopen(os.dup(1), "w") as answers:
        os.dup2(2, 1)  # output that a backend prints must not be mistaken for an answer
        _serve(sys.stdin, answers)
