"""Rows of results as the page's table shows them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

Rows = Sequence[Sequence[float]]


@dataclass(frozen=True)
class ShownRow:
    """A trial: the answer, whether it was accepted, and its error if the true pose is known."""

    frame: str
    method: str
    outcome: str
    accepted: bool
    reason: str
    confidence: float | None
    error: tuple[float, float] | None  # of the position, and of the orientation in degrees
    sigma: float | None  # standard deviation of the position
    pose: tuple[float, ...] | None  # T_world_camera, 16 numbers by rows


def shown_row(
    frame: str, method: str, outcome: str, accepted: bool, reason: str, confidence: float | None,
    error: tuple[float, float] | None, covariance: Rows | None, T_world_camera: Rows | None,
) -> ShownRow:  # fmt: skip
    """Return a row of the table; pose and covariance are given as rows of their matrices."""
    variance = math.nan if covariance is None else sum(covariance[i][i] for i in range(3))
    return ShownRow(
        frame, method, outcome, accepted, reason, confidence, error,
        math.sqrt(variance) if variance >= 0 and math.isfinite(variance) else None,
        None if T_world_camera is None else tuple(float(value) for row in T_world_camera for value in row),
    )  # fmt: skip
