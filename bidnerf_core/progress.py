"""The progress of long work: what its callers receive, and how they stop it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

from bidnerf_core.errors import Cancelled, InputError


@dataclass(frozen=True)
class Progress:
    """How much of one stage of some work is done. ``str()`` of it is a line for people."""

    stage: str  # such as "training"
    done: int
    total: int
    unit: str  # of what is counted, plural: "steps"
    text: str = ""  # present figures, such as the loss

    def __str__(self) -> str:
        counted = f"{self.stage}: {self.done}/{self.total} {self.unit}"
        return f"{counted}, {self.text}" if self.text else counted


ProgressCallback: TypeAlias = Callable[[Progress], None]
"""Receives the progress of long work, in the thread that does the work. An error that it raises stops the work and reaches the
caller."""
Cancel: TypeAlias = Callable[[], bool]
"""Returns whether work is to stop, such as ``threading.Event().is_set``."""


def check_cancelled(cancel: Cancel | None, stage: str) -> None:
    """Raise ``Cancelled`` if work is to stop, and ``InputError`` for what cannot be asked, such as an event itself."""
    if cancel is not None and not callable(cancel):
        raise InputError(
            f"cancel is a {type(cancel).__name__}, expected a function, such as the is_set of an event"
        )
    if cancel is not None and cancel():
        raise Cancelled(f"cancelled during stage {stage!r}")


def counter(
    stage: str, unit: str, progress: ProgressCallback | None = None, cancel: Cancel | None = None
) -> Callable[[int, int], None]:
    """Return a function of the number done and the total, which reports them and raises ``Cancelled`` if asked to stop."""

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
