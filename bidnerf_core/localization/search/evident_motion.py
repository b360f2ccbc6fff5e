"""Evidence that a camera moved while its rows were exposed, from the keypoints of one image."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.camera.rolling_shutter import STILL, MotionPrior
from bidnerf_core.mapping.geometry.calibration import FIXED, NOMINAL, CalibrationPrior
from bidnerf_core.mapping.geometry.observations import ObservedPoints
from bidnerf_core.mapping.geometry.resection import ReprojectionFit, log_motion_evidence, resect
from bidnerf_core.mapping.landmarks.landmark_map import LandmarkMap

ENOUGH_POINTS = 20
"""Least number of points that determine a motion: with fewer, the noise is as uncertain as the motion itself."""
SHARE_MOVING, SHARE_AS_MAP = 1 / 30, 0.8
"""Prior probability that an image shows a motion, and that it does if those of the map do.

The first is low because lens stabilisers, and lenses that the intrinsics do not describe, distort images in similar ways.
"""

LARGEST_MOTION = 22.5
"""Largest squared motion, in standard deviations of its prior (chi-squared at 99.9 %, six degrees of freedom).

A larger motion more probably makes up for another camera, such as that of an image resized to another shape. It is not taken, and
the shift of the pose that it would bring counts as doubt.
"""
NEGLIGIBLE = 1e-3
"""Probability of a motion below which it adds nothing to the doubt about a pose."""
TURNED = 0.1
"""Share of these whose rows run across those that the image's shape suggests: crops, turned square images, other sensors."""


@dataclass(frozen=True, eq=False)
class EvidentMotion:
    """How far the camera may have moved, and what the doubt about that adds to the covariance of its pose."""

    prior: MotionPrior = STILL  # ``STILL`` if it is more probable that the camera did not move
    doubt: Float[Tensor, "6 6"] = field(default_factory=lambda: torch.zeros((6, 6), dtype=torch.float64))


def share_moving(landmarks: LandmarkMap) -> float:
    """Return the prior probability that an image of the scene shows a motion: its camera may be that of the map's images."""
    return max(SHARE_MOVING, SHARE_AS_MAP * landmarks.moving)


def evident_motion(
    data: ObservedPoints,
    fit: ReprojectionFit,
    correlation: float,
    camera: CalibrationPrior = NOMINAL,
    share: float = SHARE_MOVING,
) -> EvidentMotion:
    """Return the more probable of a camera at rest and one that moved, and the doubt about the pose that is left.

    ``fit`` is a fit to these points, and ``share`` the prior probability of a motion. The intrinsics are free in all fits
    that are compared, as far as the prior ``camera`` leaves them open: what they explain is not a motion.
    """
    if len(data) < ENOUGH_POINTS:
        return EvidentMotion()
    motion = MotionPrior.usual(float(data.in_camera(fit.T_world_rig)[:, 2].median()))
    still, moving = (
        resect(data, fit.T_world_rig, fit.noise, camera, fit.calibration, correlation, prior)
        for prior in (STILL, motion)
    )
    transposed = replace(data, exposure_times=data.transposed_exposure_times)
    turned = resect(transposed, fit.T_world_rig, fit.noise, camera, fit.calibration, correlation, motion)
    log_odds = [
        log_motion_evidence(points, found, still, motion, correlation) + math.log(probability)
        for points, found, probability in (
            (data, moving, share * (1 - TURNED)), (transposed, turned, share * TURNED)
        )
    ]  # fmt: skip
    of_still, of_moving, of_turned = torch.tensor([math.log(1 - share), *log_odds]).softmax(0).tolist()
    if not all(map(math.isfinite, (of_still, of_moving, of_turned))):
        return EvidentMotion()
    if max(of_moving, of_turned) < NEGLIGIBLE:
        return EvidentMotion()
    takes_motion = of_moving > of_still and moving.motion_in_deviations(motion) <= LARGEST_MOTION
    # The pose is found with known intrinsics, so the doubt about it follows from fits with the same ones.
    still, moving, turned = (
        resect(points, fit.T_world_rig, found.noise, FIXED, fit.calibration, correlation, prior)
        for points, found, prior in (
            (data, still, STILL),
            (data, moving, motion),
            (transposed, turned, motion),
        )
    )
    chosen = moving if takes_motion else still
    doubt = of_turned * _square(chosen, turned)
    if takes_motion:
        return EvidentMotion(motion, doubt + of_still * _square(chosen, still))
    return EvidentMotion(STILL, doubt + of_moving * (_square(chosen, moving) + moving.covariance_by_motion))


def _square(fit: ReprojectionFit, other: ReprojectionFit) -> Float[Tensor, "6 6"]:
    """Return the outer product of the right update from one fit to another with itself."""
    shift = (fit.T_world_rig.inverse() @ other.T_world_rig).log()
    return torch.outer(shift, shift)
