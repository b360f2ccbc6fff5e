"""Progress of an evaluation on stderr, and handling of Ctrl-C."""

from __future__ import annotations

import signal
import time
from types import FrameType

from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn
from rich.progress import Progress as Bar

from bidnerf_core.cli.output import console, say
from bidnerf_core.cli.progress import LINE_EVERY
from bidnerf_core.progress import Progress, duration_text


class TrialProgress:
    """A progress bar for trials, which is called with each ``Progress``.

    As a context manager, it makes Ctrl-C set ``stopping``, and a second Ctrl-C interrupt at once.
    """

    def __init__(self) -> None:
        self.stopping = False
        self._began = self._spoke = time.monotonic()
        self._bar = Bar(
            TextColumn("trials"), BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[numbers]}"),
            TimeElapsedColumn(), console=console, disable=not console.is_terminal,
        )  # fmt: skip
        self._task = self._bar.add_task("", total=None, numbers="")

    def __enter__(self) -> TrialProgress:
        self._previous = signal.signal(signal.SIGINT, self._interrupt)
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()
        signal.signal(signal.SIGINT, self._previous)

    def __call__(self, progress: Progress) -> None:
        """Show how many trials are done. The time left is too low until every worker has finished a trial."""
        now = time.monotonic()
        left = (now - self._began) / progress.done * (progress.total - progress.done)
        numbers = f"{progress.text}, {duration_text(left)} left"
        self._bar.update(self._task, completed=progress.done, total=progress.total, numbers=numbers)
        if not console.is_terminal and (progress.done == progress.total or now - self._spoke > LINE_EVERY):
            self._spoke = now
            say(f"{progress.done}/{progress.total} trials, {numbers}")

    def cancelled(self) -> bool:
        """Return whether Ctrl-C was pressed."""
        return self.stopping

    def _interrupt(self, number: int, frame: FrameType | None) -> None:
        if self.stopping:
            raise KeyboardInterrupt
        self.stopping = True
        console.print("waiting for the trials under way (Ctrl-C again: at once)", markup=False)
