"""The progress of a training, its state, and the interface that receives them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from torch import Tensor


@dataclass(frozen=True)
class TrainingStep:
    """One step of training, for display."""

    step: int
    total: int
    loss: float
    psnr: float
    samples_per_ray: float = float("nan")


@dataclass(frozen=True)
class TrainingState:
    """All that is needed to resume a training as if it had not been interrupted."""

    step: int
    field: dict[str, Tensor]
    # Adam's moments, the state of the random generator, and parameters learned jointly with the field
    optimizer: dict[str, Tensor]


@runtime_checkable
class Report(Protocol):
    """Receives a recipe's progress and keeps its state."""

    def resume(self) -> TrainingState | None:
        """Return the state to resume from, or None to start from scratch."""
        ...

    def step(self, progress: TrainingStep) -> None:
        """Receive the progress after each step."""
        ...

    def due(self, step: int) -> bool:
        """Return whether ``save`` is to be called after this step."""
        ...

    def save(self, state: TrainingState) -> None:
        """Store the state."""
        ...

    @property
    def stopping(self) -> bool:
        """Whether to save and stop after the current step."""
        ...


class Silent:
    """A report without display or checkpoints."""

    stopping = False

    def resume(self) -> TrainingState | None:
        return None

    def step(self, progress: TrainingStep) -> None:
        pass

    def due(self, step: int) -> bool:
        return False

    def save(self, state: TrainingState) -> None:
        pass


class TrainingStopped(Exception):
    """Training stopped on request; its state was saved at ``step``."""

    def __init__(self, step: int) -> None:
        super().__init__(f"training stopped after step {step}")
        self.step = step
