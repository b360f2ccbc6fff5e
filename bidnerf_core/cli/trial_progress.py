"""Progress of an evaluation on stderr, and handling of Ctrl-C."""

from __future__ import annotations

import time
from types import FrameType

from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
)

from bidnerf_core.cli.output import console, say
from bidnerf_core.cli.progress import LINE_EVERY, StoppableBar
from bidnerf_core.evaluation.summary import succeeded
from bidnerf_core.evaluation.trial import TrialResult


class TrialProgress(StoppableBar):
    """A progress bar for trials.

    As a context manager, it makes Ctrl-C wait for the running trials, and a second Ctrl-C stop them.
    """

    def __init__(self, total: int, at_once: int) -> None:
        self.total, self.count, self.right = total, 0, 0
        self.stopping = False
        self._at_once = at_once
        self._began = self._spoke = time.monotonic()
        self._bar = Progress(
            TextColumn("trials"), BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[numbers]}"),
            TimeElapsedColumn(), console=console, disable=not console.is_terminal,
        )  # fmt: skip
        self._task = self._bar.add_task("", total=total, numbers="")

    def done(self, result: TrialResult) -> None:
        """Count one more finished trial."""
        self.count += 1
        self.right += succeeded(result)
        numbers = f"{self.right} within 5 deg and 0.05 m, {duration_text(self._left())} left"
        self._bar.update(self._task, completed=self.count, numbers=numbers)
        now = time.monotonic()
        if not console.is_terminal and (self.count == self.total or now - self._spoke > LINE_EVERY):
            self._spoke = now
            say(f"{self.count}/{self.total} trials, {numbers}")

    def _left(self) -> float:
        """Return the seconds left at the mean rate so far, which is too low until every worker has finished a trial."""
        each = (time.monotonic() - self._began) / self.count
        return each * (self.total - self.count)

    def _interrupt(self, number: int, frame: FrameType | None) -> None:
        if self.stopping:
            raise KeyboardInterrupt
        self.stopping = True
        console.print(f"waiting for {self._at_once} trials under way (Ctrl-C again: at once)", markup=False)


def duration_text(seconds: float) -> str:
    """Return a duration in words, such as 50 s, 12 min or 3 h 5 min."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 90 else f"{minutes // 60} h {minutes % 60} min"
