"""Threads for operations that torch runs on one core: gathering from a table and scattering into a table."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from threading import Barrier, Lock

import torch

from bidnerf_core.devices import set_threads_here, threads_at_most

THREADED = 4096  # number of points from which several threads are worthwhile

_pools: dict[int, ThreadPoolExecutor] = {}  # by number of threads
_opening = Lock()
_for_pools: ContextVar[int | None] = ContextVar("for_pools", default=None)  # threads, in ``pools_only``


@contextmanager
def pools_only(device: torch.device) -> Iterator[None]:
    """Restrict torch's own operators to one thread within the block, so that only ``concurrently`` uses several; no effect on a GPU.

    A training step consists of hundreds of short operators. On two cores, waking threads for each of them
    took longer than they saved.
    """
    if device.type != "cpu":
        yield
        return
    with threads_at_most(1) as usual:
        token = _for_pools.set(usual)
        try:
            yield
        finally:
            _for_pools.reset(token)


def threads_for(points: int, device: torch.device) -> int:
    """Return how many threads to use for ``points`` points: one on a GPU, or if there is too little work for more."""
    worth = device.type == "cpu" and points >= THREADED
    return (_for_pools.get() or torch.get_num_threads()) if worth else 1


def slices(count: int, size: int) -> list[slice]:
    """Return slices of at most ``size`` items that together cover ``count`` items, to divide work among tasks."""
    return [slice(start, min(start + size, count)) for start in range(0, count, size)]


def concurrently(tasks: Iterable[Callable[[], None]], threads: int) -> None:
    """Run independent tasks on CPU threads, each of which uses one core; no task may record gradients.

    Torch's operators release Python's global interpreter lock while they compute. Exceptions raised in a task
    are raised here.
    """
    if threads < 2:
        for task in tasks:
            task()
        return
    inference = torch.is_inference_mode_enabled()  # per thread, as is the recording of gradients
    for done in [_pool(threads).submit(_run, task, inference) for task in tasks]:
        done.result()


def _run(task: Callable[[], None], inference: bool) -> None:
    with torch.inference_mode(inference), torch.no_grad():
        task()


def _pool(threads: int) -> ThreadPoolExecutor:
    """Return a pool whose threads are all running, each limited to one core, so that none is still starting when the process forks."""
    with _opening:
        if threads in _pools:
            return _pools[threads]
        all_run, pool = Barrier(threads + 1), ThreadPoolExecutor(threads, "bidnerf-hashgrid")

        def begin() -> None:
            set_threads_here(1)
            all_run.wait()

        for _ in range(threads):
            pool.submit(begin)
        all_run.wait()
        return _pools.setdefault(threads, pool)


def _forget() -> None:
    """Forget the pools of the parent process, whose threads a forked process does not have."""
    global _opening
    _pools.clear()
    _opening = Lock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget)
