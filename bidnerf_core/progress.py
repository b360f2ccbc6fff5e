"""Progress reports, remarks and cancellation of long-running work, and what runs its tasks."""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Iterator
from concurrent.futures import Executor
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import TypeAlias, TypeVar

from bidnerf_core.errors import Cancelled, InputError

Item = TypeVar("Item")

log = logging.getLogger("bidnerf")
"""The logger of the remarks that users see."""


@dataclass(frozen=True)
class Progress:
    """The progress of one stage of long-running work. ``str()`` gives a human-readable line."""

    stage: str  # such as "training"
    done: int
    total: int
    unit: str  # what is counted, plural: "steps"
    text: str = ""  # current figures, such as the loss

    def __str__(self) -> str:
        counted = f"{self.stage}: {self.done}/{self.total} {self.unit}"
        return f"{counted}, {self.text}" if self.text else counted


ProgressCallback: TypeAlias = Callable[[Progress], None]
"""Function that receives the progress of long-running work, in the thread that does the work. An exception that it
raises stops the work and propagates to the caller."""
Cancel: TypeAlias = Callable[[], bool]
"""Function that returns whether the work should stop, such as the ``is_set`` of a ``threading.Event``."""


@dataclass(frozen=True)
class Job:
    """The callbacks of the current work (one receives its progress, the other may cancel it), and what runs its tasks."""

    progress: ProgressCallback | None = None
    cancel: Cancel | None = None
    executor: Executor | None = None  # None: threads of this process


_JOB: ContextVar[Job] = ContextVar("job", default=Job())  # noqa: B039 (it is frozen)


@contextmanager
def job_context(
    progress: ProgressCallback | None = None, cancel: Cancel | None = None, executor: Executor | None = None
) -> Iterator[None]:
    """Set the callbacks that receive the progress of this thread's work, or cancel it, and the executor of its tasks, within the block.

    Functions that take ``progress`` and ``cancel`` from users open this block once; the functions that they call report with
    ``counter`` and stop in ``check_cancelled``. What is None is inherited from the enclosing block. The executor, such as that of a
    cluster, runs independent tasks (see ``devices.map_tasks``) in other processes, with the same results. Raises ``InputError`` if a
    callback is not callable (for example, if ``cancel`` is an event rather than its ``is_set``).
    """
    for name, given, expected in (
        ("cancel", cancel, "a function, such as the is_set of an event"),
        ("progress", progress, "a function that takes a Progress"),
    ):
        if given is not None and not callable(given):
            raise InputError(f"{name} is a {type(given).__name__}", expected=expected)
    outer = _JOB.get()
    token = _JOB.set(Job(progress or outer.progress, cancel or outer.cancel, executor or outer.executor))
    try:
        yield
    finally:
        _JOB.reset(token)


def current_job() -> Job:
    """Return the callbacks of this thread's work, for code that passes them to another thread or calls them directly."""
    return _JOB.get()


def check_cancelled(stage: str = "localization") -> None:
    """Raise ``Cancelled`` if this thread's work should stop (see ``job_context``). Long loops call this once per iteration."""
    cancel = _JOB.get().cancel
    if cancel is not None and cancel():
        raise Cancelled(f"cancelled during stage {stage!r}")


def counter(stage: str, unit: str) -> Callable[[int, int], None]:
    """Return a function of (done, total) that reports to the current job, and raises ``Cancelled`` if the job should stop."""
    return lambda done, total: report_progress(Progress(stage, done, total, unit))


def report_each(items: Collection[Item], stage: str, unit: str) -> Iterator[Item]:
    """Yield the items, and after each report how many are done to the current job; raises ``Cancelled`` if the job should stop."""
    check_cancelled(stage)
    for number, item in enumerate(items, start=1):
        yield item
        report_progress(Progress(stage, number, len(items), unit))


def report_progress(progress: Progress) -> None:
    """Report progress to the current job (see ``job_context``), and raise ``Cancelled`` if the job should stop."""
    receive = _JOB.get().progress
    if receive is not None:
        receive(progress)
    check_cancelled(progress.stage)


def duration_text(seconds: float) -> str:
    """Return a duration in words, such as 50 s, 12 min or 3 h 5 min."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 90 else f"{minutes // 60} h {minutes % 60} min"
