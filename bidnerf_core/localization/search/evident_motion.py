"""Whether a camera moved while its rows were exposed, judged by the keypoints of one image."""

from __future__ import annotations

from bidnerf_core.mapping.calibration import NOMINAL, CalibrationPrior
from bidnerf_core.mapping.observed_points import ObservedPoints
from bidnerf_core.mapping.resection import ReprojectionFit, log_likelihood_ratio, resect
from bidnerf_core.rolling_shutter import STILL, MotionPrior

EVIDENT = 3.0
"""Logarithm of the odds from which on a camera is taken to have moved while its rows were exposed."""


def evident_motion(
    data: ObservedPoints, fit: ReprojectionFit, correlation: float, camera: CalibrationPrior = NOMINAL
) -> MotionPrior:
    """Return how far the camera may have moved; ``STILL`` unless the points that it observed show that it did.

    ``fit`` is one to these points. The intrinsics are free in both fits that are compared, as far as the prior ``camera`` leaves them
    open: what they explain is no motion.
    """
    motion = MotionPrior.usual(float(data.in_camera(fit.T_world_rig)[:, 2].median()))
    moving, still = (
        resect(data, fit.T_world_rig, fit.noise, camera, fit.calibration, correlation, prior)
        for prior in (motion, STILL)
    )
    evidence = log_likelihood_ratio(data, moving, still, correlation) + moving.log_occam_factor(motion)
    return motion if evidence > EVIDENT else STILL
