"""Progress on stderr, a training's checkpoints on disk, and Ctrl-C."""

from __future__ import annotations

import math
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import FrameType, TracebackType
from typing import TypeVar

from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    SpinnerColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from torch import nn

from bidnerf_core.cli.output import console, say
from bidnerf_core.fields.contract import RadianceField
from bidnerf_core.maps.description import MapInfo
from bidnerf_core.maps.files import save_map
from bidnerf_core.training import Progress as TrainingProgress
from bidnerf_core.training import TrainingState

CHECKPOINT_SECONDS = 60.0
LINE_EVERY = 10.0  # seconds, where stderr is not a terminal


Bar = TypeVar("Bar", bound="StoppableBar")


class StoppableBar:
    """A context that shows a progress bar and handles Ctrl-C with ``_interrupt``; both end with the context."""

    _bar: Progress

    def __enter__(self: Bar) -> Bar:
        self._previous = signal.signal(signal.SIGINT, self._interrupt)
        self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.stop()
        signal.signal(signal.SIGINT, self._previous)

    def _interrupt(self, number: int, frame: FrameType | None) -> None:
        raise KeyboardInterrupt


class StoredTraining(StoppableBar):
    """The ``Report`` of a training whose map is stored in a folder.

    As a context manager, it makes Ctrl-C stop training after the current step.
    """

    def __init__(
        self, folder: Path, info: MapInfo, state: TrainingState | None, total: int, checkpoint_seconds: float
    ) -> None:
        self.folder, self.info, self.total = folder, info, total
        self.stopping = False
        self._checkpoint_seconds = checkpoint_seconds
        self._resumed, self._first_step = state, info.step
        self._step, self._complete, self._announced = info.step, False, False
        self._began = self._saved = self._spoke = time.monotonic()
        self._bar = Progress(
            TextColumn("training"), BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[numbers]}"),
            TimeElapsedColumn(), TextColumn("left"), TimeRemainingColumn(), console=console,
            disable=not console.is_terminal,
        )  # fmt: skip
        self._task = self._bar.add_task("", total=total, numbers="", completed=info.step)

    def resume(self) -> TrainingState | None:
        return self._resumed

    def step(self, progress: TrainingProgress) -> None:
        self._resumed = None  # free it: it is as large as the field and its optimizer
        self._step, self.total = progress.step, progress.total
        numbers = f"loss {progress.loss:.5f}  PSNR {progress.psnr:.2f} dB"
        if not math.isnan(progress.samples_per_ray):  # not every recipe reports it
            numbers += f"  {progress.samples_per_ray:.1f} samples a ray"
        self._bar.update(self._task, completed=progress.step, total=progress.total, numbers=numbers)
        now = time.monotonic()
        last = progress.step == progress.total
        if not console.is_terminal and (last or now - self._spoke > LINE_EVERY):
            self._spoke = now
            done = progress.step - self._first_step
            left = (now - self._began) / max(1, done) * (progress.total - progress.step)
            say(f"step {progress.step}/{progress.total}  {numbers}  {left:.0f} s left")
        if self.stopping and not self._announced:  # not in the signal handler, which may interrupt a print
            self._announced = True
            say("stopping after this step (Ctrl-C again: at once, back to the last checkpoint)")

    def due(self, step: int) -> bool:
        return step == self.total or time.monotonic() - self._saved > self._checkpoint_seconds

    def save(self, state: TrainingState) -> None:
        now = time.monotonic()
        seconds = self.info.seconds + now - self._began
        complete = state.step >= self.total
        save_map(self.folder, replace(self.info, step=state.step, complete=complete, seconds=seconds), state)
        self._saved, self._complete = time.monotonic(), complete

    def finish(self, field: RadianceField) -> None:
        """Save once more if the backend ended without reporting its last step."""
        if not self._complete and isinstance(field, nn.Module):
            self.total = self._step
            self.save(TrainingState(self._step, field.state_dict(), {}))

    def _interrupt(self, number: int, frame: FrameType | None) -> None:
        if self.stopping:  # second Ctrl-C: stop at once, which loses the steps since the last checkpoint
            raise KeyboardInterrupt
        self.stopping = True


@contextmanager
def counted(what: str, unit: str, total: int | None = None) -> Iterator[Callable[[int, int], None]]:
    """Show how many of ``unit`` are done, their rate and the time left: a bar on a terminal, else occasional lines.

    Yields a function of the number done and the total. For a total of 1, a terminal shows only the elapsed time, and other
    outputs show nothing. A call with 0 done restarts the clock.
    """
    columns: tuple[ProgressColumn, ...] = (
        TextColumn(what), BarColumn(), TextColumn("{task.completed}/{task.total} " + unit),
        TextColumn("{task.fields[rate]}"), TextColumn("left"), TimeRemainingColumn(),
    )  # fmt: skip
    if total == 1:
        columns = (SpinnerColumn(), TextColumn(what), TimeElapsedColumn())
    began = spoke = time.monotonic()
    with Progress(
        *columns, console=console, disable=not console.is_terminal, transient=True,
        redirect_stdout=sys.stdout.isatty(),  # results on the same terminal go above the bar
    ) as bar:  # fmt: skip
        task = bar.add_task("", total=total, rate="")

        def report(done: int, of: int) -> None:
            nonlocal began, spoke
            now = time.monotonic()
            began, spoke = (began, spoke) if done else (now, now)
            each = (now - began) / max(1, done)
            rate = f"{each:.1f} s each" if each >= 1 else f"{1 / max(each, 1e-9):.1f} per second"
            bar.update(task, completed=done, total=of, rate=rate)
            last_of_a_long_run = done == of and spoke > began
            if not console.is_terminal and of > 1 and (now - spoke > LINE_EVERY or last_of_a_long_run):
                spoke = now
                say(f"{what}: {done}/{of} {unit}, {rate}, {each * (of - done):.0f} s left")

        yield report


@contextmanager
def timed(what: str) -> Iterator[None]:
    """Print how long the work in the context took."""
    began = time.monotonic()
    yield
    say(f"{what}: {time.monotonic() - began:.1f} s")
