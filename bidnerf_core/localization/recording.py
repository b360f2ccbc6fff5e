"""Records of the pose search, for visualization. Nothing is stored or computed unless a record is requested."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.devices import moved
from bidnerf_core.geometry import SE3

if TYPE_CHECKING:
    from bidnerf_core.localization.loop import Answer


@dataclass(frozen=True, eq=False)
class RecordedStep:
    """Poses considered in one step of a search."""

    caption: str
    T: SE3  # T_world_camera (h), best first, on the CPU
    scores: Float[Tensor, "h"]  # lower is better; only those of one step can be compared
    kept: int  # number of poses passed on to the next step
    compared: bool = True  # whether they are scored rivals, instead of a step towards one pose


@dataclass(eq=False)
class SearchRecord:
    """The steps of a search and the landmark-based answers, in order."""

    steps: list[RecordedStep] = field(default_factory=list)
    answers: list[Answer] = field(default_factory=list)

    def add(self, caption: str, T: SE3, scores: Float[Tensor, "h"] | None = None, kept: int = 1) -> None:
        """Record poses T (h) or a single pose; without scores, the poses must be sorted, best first."""
        T = T if T.translation.ndim == 2 else T[None]
        compared = scores is not None
        if scores is None:
            scores = torch.arange(len(T.translation), dtype=torch.float64)
        best = scores.argsort()[:400]  # only the best poses of a step are kept
        T, scores = moved((T[best], scores[best]), "cpu")
        self.steps.append(RecordedStep(caption, T, scores.double(), min(kept, len(best)), compared))


_RECORD: ContextVar[SearchRecord | None] = ContextVar("record", default=None)


@contextmanager
def recorded() -> Iterator[SearchRecord]:
    """Yield a record, to which this thread's localizations within the block add."""
    token = _RECORD.set(record := SearchRecord())
    try:
        yield record
    finally:
        _RECORD.reset(token)


def current_record() -> SearchRecord | None:
    """Return the active record; None if no record was requested."""
    return _RECORD.get()
