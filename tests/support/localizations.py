"""A made-up answer of a localization, and what answers are compared by."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch

from bidnerf import SE3, Frame, Localization, Outcome, View
from bidnerf.results import normalized_error_squared, pose_error
from optional import require

CHI2_99, CHI2_999 = 16.8, 22.5  # of six degrees of freedom


def answer(T: SE3 | None = None, outcome: Outcome = Outcome.CONVERGED, **changes: Any) -> Localization:
    """Return an answer, accepted by default."""
    pose = SE3.identity() if T is None else T
    fields = {
        "reason": "as the search has it",
        "steps": 0,
        "seconds": 1.0,
        "loss": 0.0,
        "method": "auto",
        "poses": pose[None],
        "losses": torch.zeros(0, dtype=torch.float64),
    }
    return Localization(pose, outcome, **(fields | changes))


def answer_row(error: float | None, accepted: bool | None = True, squared: float | None = 1.0, **more: Any) -> Any:
    """Return the row that benchmarks keep of an answer; ``error`` in metres and degrees alike, None for no pose."""
    errors = {"translation": error, "rotation_deg": error, "normalized_error_squared": squared}
    return errors | {"converged": accepted, "outcome": "converged", "cpu_seconds": 1.0} | more


def assert_near(T: SE3, truth: SE3, metres: float, degrees: float) -> None:
    error = pose_error(T, truth)
    assert float(error.translation) < metres, error
    assert float(error.rotation_deg) < degrees, error


def assert_covered(T: SE3, truth: SE3, covariance: torch.Tensor | None, most: float = CHI2_99) -> None:
    """Assert that a pose is as near the truth as its covariance says."""
    assert float(normalized_error_squared(T, truth, require(covariance))) < most


def colour_only(view: View) -> View:
    """Return a view without its depth."""
    return View(without_depth(view.frame), view.T_ref_camera)


def without_depth(frame: Frame) -> Frame:
    return replace(frame, depth=None)
