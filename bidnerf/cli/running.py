"""Support for running commands: their progress is displayed, and Ctrl-C stops them where their work can be saved."""

from __future__ import annotations

import contextlib
import sys
import threading
import time
from collections.abc import Callable, Iterator

from rich.progress import (
    BarColumn,
    ProgressColumn,
    SpinnerColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.progress import Progress as Bar

from bidnerf.cli.output import console, say
from bidnerf.cli.signals import Interrupted, installed_handler
from bidnerf_core.errors import Cancelled
from bidnerf_core.progress import Progress, duration_text, job_context

SILENCE = 60.0
"""Seconds without a line after which a stage says that it goes on, if stderr is not a terminal."""


class Display:
    """Displays the progress that it is called with: as a bar for each stage on a terminal, else as occasional lines.

    A stage begins when its name first appears, or when it is reported with nothing done. A stage with a single unit
    shows only the elapsed time. If stderr is not a terminal, ``remind`` says after a silent minute that the stage goes on.
    """

    def __init__(self) -> None:
        self._stage, self._first, self._counted = "", 0, "working"
        self._began = self._spoke = time.monotonic()
        self.bar: Bar | None = None

    def remind(self) -> None:
        """Print how long the stage has taken, unless there is a bar or a line was printed in the last minute."""
        if self.bar is None and time.monotonic() - self._spoke >= SILENCE:
            self._spoke = time.monotonic()
            say(f"{self._counted}, {duration_text(self._spoke - self._began)} so far")

    def __call__(self, now: Progress) -> None:
        if now.stage != self._stage or not now.done:
            self._begin(now)
        self._counted = f"{Progress(now.stage, now.done, now.total, now.unit)}" if now.total > 1 else now.stage
        elapsed = time.monotonic() - self._began
        each = elapsed / max(1, now.done - self._first)
        rate = f"{each:.1f} s each" if each >= 1 else f"{1 / each:.1f} per second" if each > 1e-6 else ""
        text = now.text or rate
        if self.bar is not None:
            self.bar.update(self.bar.task_ids[0], completed=now.done, total=now.total, text=text)
            return
        last = now.done == now.total and (bool(now.text) or self._spoke > self._began)
        # If stderr is not a terminal, a line every ten seconds is enough.
        if now.total > 1 and now.done and (last or time.monotonic() - self._spoke > 10):
            self._spoke = time.monotonic()
            counted = Progress(now.stage, now.done, now.total, now.unit, text)
            say(f"{counted}, {duration_text(each * (now.total - now.done))} left")

    def _begin(self, now: Progress) -> None:
        self._stage, self._first = now.stage, max(0, now.done - 1)
        self._began = self._spoke = time.monotonic()
        if not console.is_terminal:
            return
        if self.bar is not None:
            self.bar.stop()
        columns: tuple[ProgressColumn, ...] = (
            TextColumn(now.stage),
            BarColumn(),
            TextColumn("{task.completed}/{task.total} " + now.unit),
            TextColumn("{task.fields[text]}"),
            TextColumn("left"),
            TimeRemainingColumn(),
        )
        if now.total == 1:
            columns = (SpinnerColumn(), TextColumn(now.stage), TimeElapsedColumn())
        # Results on the same terminal appear above the bar.
        self.bar = Bar(*columns, console=console, transient=True, redirect_stdout=sys.stdout.isatty())
        self.bar.add_task("", total=now.total, text="")
        self.bar.start()


@contextlib.contextmanager
def report_time(what: str) -> Iterator[None]:
    """Print how long the work in the context took, by a clock and in CPU time, which other processes do not lengthen."""
    began = time.monotonic(), time.process_time()
    yield
    wall, used = time.monotonic() - began[0], time.process_time() - began[1]
    say(f"{what} in {duration_text(wall)} ({duration_text(used)} of CPU time)")


@contextlib.contextmanager
def display_progress() -> Iterator[None]:
    """Display the progress of the work in the context."""
    display, ended = Display(), threading.Event()

    def remind() -> None:
        while not ended.wait(SILENCE / 6):
            display.remind()

    threading.Thread(target=remind, daemon=True).start()
    try:
        with job_context(display):
            yield
    finally:
        ended.set()
        if display.bar is not None:
            display.bar.stop()


@contextlib.contextmanager
def explained_interruption(kept: Callable[[], str]) -> Iterator[None]:
    """If a signal stops the work in the context, print a line that states what is ``kept`` and how to go on, unless one has been printed."""
    try:
        yield
    except Interrupted as stopped:
        if not stopped.is_explained:
            stopped.is_explained = True
            say(kept())
        raise


@contextlib.contextmanager
def interruptible_work(
    announcement: str = "stopping after this step (Ctrl-C again: at once)",
    kept: str | None = None,
    at_once: Callable[[], str] = lambda: "stopped; what was finished is kept, and the same command goes on from there",
) -> Iterator[None]:
    """Display the progress of the work in the context, and let Ctrl-C stop it at its next check; a second Ctrl-C stops it at once.

    A line states what was ``kept`` and how to go on. By default, it is what the library says if the work stopped at a check, and what
    ``at_once`` returns if another signal or a second Ctrl-C stopped it elsewhere. ``Interrupted`` is raised.
    """
    handler = installed_handler()
    handler.works, handler.announce = True, lambda: say(announcement)
    try:
        with (
            explained_interruption(at_once if kept is None else lambda: kept),
            job_context(cancel=lambda: handler.waiting is not None),
            display_progress(),
        ):
            yield
    except Cancelled as stopped:
        if handler.waiting is None:  # something other than Ctrl-C stopped it
            raise
        say(kept or str(stopped))
        raise Interrupted(handler.waiting, is_explained=True) from stopped
    finally:
        handler.works, handler.waiting = False, None
