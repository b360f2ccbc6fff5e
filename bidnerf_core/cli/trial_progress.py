"""Progress of an evaluation on stderr, and Ctrl-C."""

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

from bidnerf_core.cli.common import console, say
from bidnerf_core.cli.progress import LINE_EVERY, StoppableBar
from bidnerf_core.evaluation.errors import CRITERIA
from bidnerf_core.evaluation.trials import TrialResult


class TrialProgress(StoppableBar):
    """Use as a context: Ctrl-C then waits for the trials under way; a second one does not."""

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
        self.count += 1
        self.right += succeeded(result)
        numbers = f"{self.right} within 5 deg and 0.05 m, {shown(self._left())} left"
        self._bar.update(self._task, completed=self.count, numbers=numbers)
        now = time.monotonic()
        if not console.is_terminal and (self.count == self.total or now - self._spoke > LINE_EVERY):
            self._spoke = now
            say(f"{self.count}/{self.total} trials, {numbers}")

    def _left(self) -> float:
        """Seconds; at first the workers are all still at their first trial, so the last of them counts more."""
        each = (time.monotonic() - self._began) / self.count
        return each * (self.total - self.count)

    def _interrupt(self, number: int, frame: FrameType | None) -> None:
        if self.stopping:
            raise KeyboardInterrupt
        self.stopping = True
        console.print(f"waiting for {self._at_once} trials under way (Ctrl-C again: at once)", markup=False)


def succeeded(result: TrialResult) -> bool:
    trace = result.errors.as_error()
    return result.error is not None and bool(CRITERIA["5deg 0.05"](trace[-1], trace[0]))


def shown(seconds: float) -> str:
    """In words: 50 s, 12 min, 3 h 5 min."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 90 else f"{minutes // 60} h {minutes % 60} min"
