"""``Checkpoints``: stores a map at intervals during training."""

from __future__ import annotations

import logging
import math
import time
from dataclasses import replace
from pathlib import Path

from torch import nn

from bidnerf_core.fields import RadianceField
from bidnerf_core.mapping import (
    LandmarkMap,
)
from bidnerf_core.maps.description import MapInfo, load_info
from bidnerf_core.maps.store import write_parts
from bidnerf_core.progress import (
    Progress,
    current_job,
)
from bidnerf_core.training import TrainingState, TrainingStep

log = logging.getLogger("bidnerf")

USUAL_SECONDS = 60.0
"""Time between checkpoints."""


class Checkpoints:
    """The ``Report`` of a training run, which saves checkpoints.

    States are saved to ``folder``, or not at all if that is None; ``info`` describes the last saved state.
    Progress is reported to the current job, which may also stop the training. ``state`` is the training state
    to resume from, ``seconds`` is the time between checkpoints, and ``landmarks`` are stored with the first
    checkpoint if they are not in the folder yet.
    """

    def __init__(
        self,
        info: MapInfo,
        folder: Path | None = None,
        state: TrainingState | None = None,
        seconds: float = USUAL_SECONDS,
        landmarks: LandmarkMap | None = None,
    ) -> None:
        self.info, self.folder = info, folder
        self._state, self._seconds, self._job = state, seconds, current_job()
        self._step = self._total = info.step
        self._landmarks = landmarks
        self._earlier, self._began = info.seconds, time.monotonic()
        self._saved = self._began

    @property
    def stopping(self) -> bool:
        return self._job.cancel is not None and self._job.cancel()

    def resume(self) -> TrainingState | None:
        return self._state

    def step(self, progress: TrainingStep) -> None:
        self._state = None  # free it: it is as large as the field and its optimizer
        self._step, self._total = progress.step, progress.total
        if self._job.progress is None:
            return
        figures = f"loss {progress.loss:.5f}  PSNR {progress.psnr:.2f} dB"
        if not math.isnan(progress.samples_per_ray):  # not every recipe reports it
            figures += f"  {progress.samples_per_ray:.1f} samples per ray"
        self._job.progress(Progress("training", progress.step, progress.total, "steps", figures))

    def due(self, step: int) -> bool:
        waited = self.folder is not None and time.monotonic() - self._saved > self._seconds
        return step == self._total or waited

    def save(self, state: TrainingState) -> None:
        seconds = self._earlier + time.monotonic() - self._began
        info = replace(self.info, step=state.step, complete=state.step >= self._total, seconds=seconds)
        if self.folder is not None:
            if info.weights:  # the first save may replace another map, whose anchor does not count
                info = replace(info, anchor=load_info(self.folder).anchor)
            info = write_parts(self.folder, info, state, landmarks=self._landmarks, keep=True)
            self._landmarks = None
        self.info = info
        self._saved = time.monotonic()

    def finish(self, field: RadianceField) -> None:
        """Save once more if the backend ended without reporting its last step."""
        if not self.info.complete and isinstance(field, nn.Module):
            self._total = self._step
            self.save(TrainingState(self._step, field.state_dict(), {}))
