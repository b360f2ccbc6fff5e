"""Training of fields by cell: first the overview, then the cells, one after another or, on a cluster, side by side."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

from torch import Tensor

from bidnerf_cells.config import CellsConfig
from bidnerf_cells.field import CellsField
from bidnerf_cells.photos import of_mean_exposure, surface_depth, view_of_cell
from bidnerf_core.backend import Report, SceneBounds, View, device_of
from bidnerf_core.devices import map_tasks, move_to
from bidnerf_core.progress import current_job
from bidnerf_core.training import Silent, TrainingState, TrainingStep, TrainingStopped

LEARNED, EXPOSURE = "beside.", "exposure."
"""Beginnings of the names, in a training state, of what is learned about exposure: by the part in training, and by the overview."""


class CellsBackend:
    """A backend whose fields consist of fields of another backend."""

    summary = "fields of another backend side by side, one for each cell of a large scene (as Mega-NeRF and Block-NeRF)"
    config_type = CellsConfig

    def build(self, config: CellsConfig, bounds: SceneBounds) -> CellsField:
        return CellsField(config, bounds)

    def train(self, field: CellsField, views: Sequence[View], config: CellsConfig, report: Report) -> None:
        """Train the overview and, by the surfaces and exposures that it has learned, each cell on what the photos show of it.

        If the current job has an executor, such as a cluster, each cell is one of its tasks. Cells that no photo shows remain
        untrained.
        """
        training = Training(field, config, report)
        overview, *cells = training.parts
        if overview.is_left:
            overview.train(views)
        left = [cell for cell in cells if cell.is_left]
        photos = training.photos_by_cell(views, left)
        if current_job().executor is None:
            for cell, shown in zip(left, photos, strict=True):
                cell.train(shown)
            return
        device = str(device_of(field))
        tasks = ((config, *cell.task, shown, device) for cell, shown in zip(left, photos, strict=True))
        for cell, (weights, figures) in zip(left, map_tasks(train_cell, tasks), strict=True):
            cell.field.load_state_dict(weights)
            cell.finish(figures is not None, figures)


def train_cell(
    config: CellsConfig,
    steps: int,
    bounds: SceneBounds,
    weights: dict[str, Tensor],
    state: TrainingState | None,
    views: Sequence[View],
    device: str,
) -> tuple[dict[str, Tensor], TrainingStep | None]:
    """Train a cell in another process. Return its weights and the last figures; None if no photo shows it.

    ``weights`` are those with which it begins, and ``state`` is the training state to resume from, if any.
    """
    settings, report = config.settings_of(steps), LastFigures(state)
    if views:
        field: Any = move_to(config.backend.build(settings, bounds), device)
        field.load_state_dict(weights)
        config.backend.train(field, views, settings, report)
        weights = dict(move_to(field, "cpu").state_dict())
    return weights, report.figures


class LastFigures(Silent):
    """A report that only remembers the last figures."""

    def __init__(self, state: TrainingState | None) -> None:
        self.state = state
        self.figures: TrainingStep | None = None

    def resume(self) -> TrainingState | None:
        return self.state

    def step(self, progress: TrainingStep) -> None:
        self.figures = progress

    def save(self, state: TrainingState) -> None:
        """Ignore the state: it is never due."""


class Training:
    """The training of a field, one after another in its parts: the overview and each cell."""

    def __init__(self, field: CellsField, config: CellsConfig, report: Report) -> None:
        self.field, self.config, self.report = field, config, report
        self.state = report.resume() or TrainingState(0, {}, {})
        if self.state.step:
            field.load_state_dict(self.state.field)
        self.exposure = below(EXPOSURE, self.state.optimizer)  # the state of the overview's ``ColourTransforms``
        self.figures = TrainingStep(0, config.steps, 0.0, 0.0)  # the last ones
        self.parts = [Part(self, number) for number in range(len(field.cells) + 1)]

    def photos_by_cell(self, views: Sequence[View], cells: Sequence[Part]) -> Iterator[list[View]]:
        """Yield what the photos show of each of the cells."""
        photos = of_mean_exposure(views, self.exposure)
        depths = [surface_depth(view, self.field) for view in photos] if cells else []
        for cell in cells:
            seen = (view_of_cell(*photo, self.field.grid, cell.number) for photo in zip(photos, depths, strict=True))
            yield [view for view in seen if view is not None]

    def save(self, step: int, optimizer: dict[str, Tensor]) -> None:
        """Have the state after a step saved."""
        learned = {EXPOSURE + name: value for name, value in self.exposure.items()}
        self.report.save(TrainingState(step, dict(self.field.state_dict()), optimizer | learned))


class Part(Report):
    """The overview (0) or a cell, and the report of its training, which counts its steps among those of all parts."""

    def __init__(self, training: Training, index: int) -> None:
        whole = training.field
        self.training, self.number = training, index - 1
        self.field: Any = whole.cells[self.number] if index else whole.overview
        self.first, self.end = (0, *training.config.ends(len(whole.cells)))[index : index + 2]
        self.steps = self.end - self.first
        self._reported, self._due, self._stopping = 0, False, False

    @property
    def is_left(self) -> bool:
        """Whether it has steps that are not done."""
        return self.end > max(self.first, self.training.state.step)

    @property
    def task(self) -> tuple[int, SceneBounds, dict[str, Tensor], TrainingState | None]:
        """The arguments of ``train_cell`` that differ from cell to cell."""
        weights = dict(move_to(self.field, "cpu").state_dict())
        return self.steps, self.training.field.grid.bounds_of(self.number), weights, self.resume()

    def train(self, views: Sequence[View]) -> None:
        """Train it here on the views, if there are any. Raises ``TrainingStopped`` on request."""
        config = self.training.config
        try:
            if views:
                config.backend.train(self.field, views, config.settings_of(self.steps), self)
        except TrainingStopped as stopped:
            raise TrainingStopped(self.first + stopped.step) from stopped
        self.finish(bool(views), None)

    def finish(self, trained: bool, figures: TrainingStep | None) -> None:
        """Report that all its steps are done, with the figures of the last one. Raises ``TrainingStopped`` on request."""
        if trained:
            self._mark({})
        if self._reported < self.steps:
            self.step(replace(figures or self.training.figures, step=self.steps))
            self._due = self.training.report.due(self.end)
            if self.stopping or self._due:
                self.training.save(self.end, {})
        if self._stopping and self.end < self.training.config.steps:
            raise TrainingStopped(self.end)

    def _mark(self, exposure: dict[str, Tensor]) -> None:
        """Note that it is trained, and what it has learned about the exposure of the photos."""
        if self.number >= 0:
            self.training.field.trained[self.number] = True
        else:
            self.training.exposure |= exposure

    # The report to the part's recipe.

    def resume(self) -> TrainingState | None:
        state, prefix = self.training.state, "overview." if self.number < 0 else f"cells.{self.number}."
        if not self.first < state.step < self.end:
            return None
        return TrainingState(state.step - self.first, below(prefix, state.field), state.optimizer)

    def step(self, progress: TrainingStep) -> None:
        self._reported = progress.step
        total = self.training.config.steps
        self.training.figures = replace(progress, step=self.first + progress.step, total=total)
        self.training.report.step(self.training.figures)

    def due(self, step: int) -> bool:
        self._due = self.training.report.due(self.first + step)
        return self._due or step == self.steps

    def save(self, state: TrainingState) -> None:
        if state.step == self.steps:
            self._mark(below(LEARNED, state.optimizer))
        if self._due or self._stopping:
            self.training.save(self.first + state.step, state.optimizer)

    @property
    def stopping(self) -> bool:
        self._stopping = self.training.report.stopping or self._stopping
        return self._stopping


def below(prefix: str, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """Return the tensors whose names begin with a prefix, under the rest of their names."""
    return {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}
