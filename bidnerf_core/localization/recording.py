"""Records of how a pose was found, for programs that show it. Nothing is kept, or computed, unless a record is asked for."""

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
from bidnerf_core.geometry.se3 import SE3

if TYPE_CHECKING:
    from bidnerf_core.localization.landmarks.pose import LandmarkPose

MOST_POSES = 400
"""Number of poses of a step that are kept, the best ones."""


@dataclass(frozen=True, eq=False)
class RecordedStep:
    """Poses that were considered at the same time."""

    caption: str
    T: SE3  # T_world_camera (h), best first, on the CPU
    scores: Float[Tensor, "h"]  # lower is better; only those of one step can be compared
    kept: int  # how many of them went on to the next step
    compared: bool = True  # whether they are rivals, with scores, rather than a step towards one pose


@dataclass(frozen=True, eq=False)
class ComparedExplanation:
    """Another explanation of the images, and how it compares with the pose that was found."""

    reason: str
    log_odds: float  # of the pose that was found against it
    T: SE3 | None  # its pose T_world_camera; None for a mirror image


@dataclass(eq=False)
class SearchRecord:
    """The steps of a search, what landmarks said about poses, and the explanations that were compared, in order."""

    steps: list[RecordedStep] = field(default_factory=list)
    landmarks: list[LandmarkPose] = field(default_factory=list)
    explanations: list[ComparedExplanation] = field(default_factory=list)

    def add(self, caption: str, T: SE3, scores: Float[Tensor, "h"] | None = None, kept: int = 1) -> None:
        """Keep poses T (h) or a single one; without scores they are in order, best first."""
        T = T if T.translation.ndim == 2 else T[None]
        compared = scores is not None
        if scores is None:
            scores = torch.arange(len(T.translation), dtype=torch.float64)
        best = scores.argsort()[:MOST_POSES]
        T, scores = moved((T[best], scores[best]), "cpu")
        self.steps.append(RecordedStep(caption, T, scores.double(), min(kept, len(best)), compared))


_RECORD: ContextVar[SearchRecord | None] = ContextVar("record", default=None)


@contextmanager
def recorded() -> Iterator[SearchRecord]:
    """Yield a record that is filled by the localizations of this thread within the block."""
    token = _RECORD.set(record := SearchRecord())
    try:
        yield record
    finally:
        _RECORD.reset(token)


def current_record() -> SearchRecord | None:
    """Return the record to add to; None where nobody asked for one."""
    return _RECORD.get()
