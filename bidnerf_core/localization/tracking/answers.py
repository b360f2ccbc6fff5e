"""The localizations that a tracker returns."""

from __future__ import annotations

import math

import torch

from bidnerf_core.geometry.se3 import SE3
from bidnerf_core.localization.result import Localization, Outcome, Verdict
from bidnerf_core.localization.tracking.motion import Motion

METHOD = "track"
"""Method name of the poses that a tracker finds."""


def tracked_localization(motion: Motion, verdict: Verdict, predicted: Motion, loss: float) -> Localization:
    """Return the state of the motion as the answer for a frame; its path leads from the prediction to the pose."""
    T = motion.T_world_camera
    return Localization(
        T_world_camera=T,
        outcome=verdict.outcome,
        reason=verdict.reason,
        steps=1,
        seconds=0.0,
        loss=loss,
        method=METHOD,
        poses=SE3.stack([predicted.T_world_camera, T]),
        losses=torch.tensor([loss], dtype=torch.float64),
        covariance=motion.covariance,
    )


def unknown(start: SE3 | None, extent: float) -> Localization:
    """Return the answer for a frame when neither its pose nor that of any frame before it is known.

    ``extent`` (metres) is the size of the scene, in which the camera may be anywhere.
    """
    T = SE3.identity() if start is None else start
    covariance = torch.diag(torch.tensor([extent] * 3 + [math.pi] * 3).double() ** 2)
    return Localization(
        T, Outcome.TOO_FEW_MATCHES, "the beginning of the sequence has not been recognised yet", 0, 0.0, 1.0,
        METHOD, T[None], torch.zeros(0, dtype=torch.float64), covariance,
    )  # fmt: skip
