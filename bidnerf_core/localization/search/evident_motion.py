"""Whether a camera moved while its rows were exposed, judged by the keypoints of one image."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.mapping.calibration import NOMINAL, CalibrationPrior
from bidnerf_core.mapping.observed_points import ObservedPoints
from bidnerf_core.mapping.resection import ReprojectionFit, log_likelihood_ratio, resect
from bidnerf_core.rolling_shutter import STILL, MotionPrior

ENOUGH_POINTS = 20
"""Least number of points that tell a motion: with fewer, the noise is as uncertain as the motion itself."""
MOVING = 1 / 30
"""Share of images that are taken to show a motion before their points are looked at: lens stabilisers and lenses that the intrinsics do not
describe bend images in similar ways.
"""


@dataclass(frozen=True, eq=False)
class EvidentMotion:
    """How far the camera may have moved, and what the doubt about that adds to the covariance of its pose."""

    prior: MotionPrior = STILL  # ``STILL`` if it is more probable that the camera did not move
    doubt: Float[Tensor, "6 6"] = field(default_factory=lambda: torch.zeros((6, 6), dtype=torch.float64))


def evident_motion(
    data: ObservedPoints, fit: ReprojectionFit, correlation: float, camera: CalibrationPrior = NOMINAL
) -> EvidentMotion:
    """Return the more probable of a camera at rest and one that moved.

    ``fit`` is one to these points. The intrinsics are free in both fits that are compared, as far as the prior ``camera`` leaves them
    open: what they explain is no motion.
    """
    if len(data) < ENOUGH_POINTS:
        return EvidentMotion()
    motion = MotionPrior.usual(float(data.in_camera(fit.T_world_rig)[:, 2].median()))
    moving, still = (
        resect(data, fit.T_world_rig, fit.noise, camera, fit.calibration, correlation, prior)
        for prior in (motion, STILL)
    )
    evidence = log_likelihood_ratio(data, moving, still, correlation) + moving.log_occam_factor(motion)
    if not math.isfinite(evidence):
        return EvidentMotion()
    log_odds = evidence + math.log(MOVING / (1 - MOVING))
    probability = float(torch.tensor(log_odds, dtype=torch.float64).sigmoid())
    shift = (still.T_world_rig.inverse() @ moving.T_world_rig).log()
    doubt = min(probability, 1 - probability) * torch.outer(shift, shift)
    return EvidentMotion(motion if probability > 0.5 else STILL, doubt)
