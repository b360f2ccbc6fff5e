"""Rows of results as the page's table shows them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class ShownRow:
    """A trial: the answer, whether it was accepted, and its error if the true pose is known."""

    frame: str
    method: str
    outcome: str
    accepted: bool
    reason: str
    confidence: float | None
    error: tuple[float, float] | None = None  # of the position, and of the orientation in degrees
    sigma: float | None = None  # standard deviation of the position
    pose: tuple[float, ...] | None = None  # T_world_camera, 16 numbers by rows

    @staticmethod
    def of(row: Any) -> ShownRow:
        """Return a row of the results of an evaluation, whose pose and covariance are rows of their matrices."""
        covariance: Sequence[Sequence[float]] | None = row.covariance
        variance = math.nan if covariance is None else sum(covariance[i][i] for i in range(3))
        return ShownRow(
            row.frame, row.method, row.outcome, row.converged, row.reason, row.confidence,
            None if row.error is None else (row.error.translation, row.error.rotation_deg),
            math.sqrt(variance) if variance >= 0 and math.isfinite(variance) else None,
            None if row.T_world_camera is None else tuple(float(value) for each in row.T_world_camera for value in each),
        )  # fmt: skip
