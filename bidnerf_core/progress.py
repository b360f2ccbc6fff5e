"""Progress of long-running work: what callers receive, and how they cancel it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import TypeAlias

from bidnerf_core.errors import Cancelled, InputError


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
"""Receives the progress of long-running work, in the thread that does it. An exception raised here stops the
work and propagates to the caller."""
Cancel: TypeAlias = Callable[[], bool]
"""Returns whether the work should stop, such as ``threading.Event().is_set``."""


def check_cancelled(cancel: Cancel | None, stage: str) -> None:
    """Raise ``Cancelled`` if the work should stop, and ``InputError`` if ``cancel`` is not callable (an event
    itself, say).
    """
    if cancel is not None and not callable(cancel):
        raise InputError(
            f"cancel is a {type(cancel).__name__}", expected="a function, such as the is_set of an event"
        )
    if cancel is not None and cancel():
        raise Cancelled(f"cancelled during stage {stage!r}")


_STOP: ContextVar[Cancel | None] = ContextVar("stop", default=None)


@contextmanager
def stopped_by(cancel: Cancel) -> Iterator[None]:
    """Let localizations and renderings of this thread within the block raise ``Cancelled`` soon after ``cancel`` returns True."""
    token = _STOP.set(cancel)
    try:
        yield
    finally:
        _STOP.reset(token)


def check_stopped() -> None:
    """Raise ``Cancelled`` if this thread's work should stop, see ``stopped_by``. Called once per iteration of a long loop."""
    check_cancelled(_STOP.get(), "localization")


def counter(
    stage: str, unit: str, progress: ProgressCallback | None = None, cancel: Cancel | None = None
) -> Callable[[int, int], None]:
    """Return a function of (done, total) that reports progress and raises ``Cancelled`` on request."""

    def count(done: int, total: int) -> None:
        if progress is not None:
            progress(Progress(stage, done, total, unit))
        check_cancelled(cancel, stage)

    return count


def duration_text(seconds: float) -> str:
    """Return a duration in words, such as 50 s, 12 min or 3 h 5 min."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 90 else f"{minutes // 60} h {minutes % 60} min"
