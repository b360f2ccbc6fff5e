"""A training's progress on stderr, its checkpoints on disk, and Ctrl-C."""

from __future__ import annotations

import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import FrameType, TracebackType

from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from bidnerf_core.cli.common import console, say
from bidnerf_core.storage import MapInfo, load_state, save_map
from bidnerf_core.training import Progress as TrainingProgress
from bidnerf_core.training import TrainingState

LINE_EVERY = 10.0  # seconds, where stderr is no terminal


class StoredTraining:
    """The ``Report`` of a training that keeps its map in a folder. Use as a context: Ctrl-C then stops after a step."""

    def __init__(self, folder: Path, info: MapInfo, total: int, checkpoint_seconds: float = 60.0) -> None:
        self.folder, self.info, self.total = folder, info, total
        self.stopping = False
        self._checkpoint_seconds = checkpoint_seconds
        self._resumed = load_state(folder, info) if info.weights else None
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
        numbers = f"loss {progress.loss:.5f}  PSNR {progress.psnr:.2f} dB  {progress.samples_per_ray:.1f} samples a ray"
        self._bar.update(self._task, completed=progress.step, numbers=numbers)
        now = time.monotonic()
        last = progress.step == progress.total
        if not console.is_terminal and (last or now - self._spoke > LINE_EVERY):
            self._spoke = now
            done = progress.step - self._first_step
            left = (now - self._began) / max(1, done) * (progress.total - progress.step)
            say(f"step {progress.step}/{progress.total}  {numbers}  {left:.0f} s left")

    @property
    def _first_step(self) -> int:
        return self._resumed.step if self._resumed else 0

    def due(self, step: int) -> bool:
        return step == self.total or time.monotonic() - self._saved > self._checkpoint_seconds

    def save(self, state: TrainingState) -> None:
        now = time.monotonic()
        seconds = self.info.seconds + now - self._began
        info = replace(self.info, step=state.step, complete=state.step >= self.total, seconds=seconds)
        save_map(self.folder, info, state)
        self._saved = time.monotonic()

    def __enter__(self) -> StoredTraining:
        self._previous = signal.signal(signal.SIGINT, self._interrupt)
        self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.stop()
        signal.signal(signal.SIGINT, self._previous)

    def _interrupt(self, number: int, frame: FrameType | None) -> None:
        if self.stopping:  # asked twice: at once, back to the last checkpoint
            raise KeyboardInterrupt
        self.stopping = True
        say("stopping after this step (Ctrl-C again: at once, back to the last checkpoint)")


@contextmanager
def timed(what: str) -> Iterator[None]:
    began = time.monotonic()
    yield
    say(f"{what}: {time.monotonic() - began:.1f} s")
