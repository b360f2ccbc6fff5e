"""Evidence that a camera moved while its rows were exposed, from the keypoints of one image."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.camera.rolling_shutter import STILL, MotionPrior
from bidnerf_core.geometry.rotations import left_jacobian, rotation_vector
from bidnerf_core.mapping.geometry.calibration import FIXED, NOMINAL, CalibrationPrior
from bidnerf_core.mapping.geometry.observations import ObservedPoints
from bidnerf_core.mapping.geometry.quadratic_fit import TIED, CameraPrior, QuadraticFit
from bidnerf_core.mapping.geometry.reprojection import LinearizedErrors, ReprojectionErrors, State
from bidnerf_core.mapping.geometry.resection import ReprojectionFit
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

    ``fit`` is a fit to these points, with a motion or without one, and ``share`` the prior probability of a motion. The
    intrinsics are free in all explanations that are compared, as far as the prior ``camera`` leaves them open: what they
    explain is not a motion.
    """
    if len(data) < ENOUGH_POINTS:
        return EvidentMotion()
    motion = MotionPrior.usual(float(data.in_camera(fit.T_world_rig)[:, 2].median()))
    errors = ReprojectionErrors(data, fit.T_world_rig)
    given = State.of(fit.T_world_rig, fit.calibration)

    def explained(about: QuadraticFit, prior: MotionPrior) -> Explanation:
        free = CameraPrior(np.zeros(10), torch.cat([camera.deviations, prior.deviations]).numpy())
        known = CameraPrior(given.camera, torch.cat([FIXED.deviations, prior.deviations]).numpy())
        return Explanation.of(about, free, known)

    about = QuadraticFit(
        errors, State.of(fit.T_world_rig, fit.calibration, fit.motion), fit.noise, correlation
    )
    still, moving = explained(about, STILL), explained(about, motion)
    transposed = errors.exposed_at(data.transposed_exposure_times)
    turned = explained(QuadraticFit(transposed, still.best.state, fit.noise, correlation), motion)
    log_odds = torch.tensor(
        [
            math.log(1 - share),
            math.log(share * (1 - TURNED)) + moving.log_evidence_over(still),
            math.log(share * TURNED) + turned.log_evidence_over(still),
        ]
    )
    of_still, of_moving, of_turned = log_odds.softmax(0).tolist()
    if not all(map(math.isfinite, (of_still, of_moving, of_turned))):
        return EvidentMotion()
    if max(of_moving, of_turned) < NEGLIGIBLE:
        return EvidentMotion()
    takes_motion = of_moving > of_still and moving.motion_in_deviations <= LARGEST_MOTION
    # The pose is found with known intrinsics, so the doubt about it is that with the same ones.
    chosen = moving if takes_motion else still
    doubt = of_turned * _square(chosen.pose, turned.pose)
    if takes_motion:
        return EvidentMotion(motion, doubt + of_still * _square(chosen.pose, still.pose))
    return EvidentMotion(
        STILL, doubt + of_moving * (_square(still.pose, moving.pose) + moving.covariance_by_motion)
    )


@dataclass(frozen=True, eq=False)
class Explanation:
    """How a camera that moved, or did not, explains an image's keypoints."""

    about: QuadraticFit  # the cost near the fit that the explanations start from
    free: CameraPrior  # with unknown intrinsics
    known: CameraPrior  # with the intrinsics with which the pose is found
    best: LinearizedErrors  # with unknown intrinsics
    noise: float  # pixels, of keypoints, there

    @staticmethod
    def of(about: QuadraticFit, free: CameraPrior, known: CameraPrior) -> Explanation:
        best = about.at_best(free)
        return Explanation(about, free, known, best, about.noise(best))

    @property
    def motion_in_deviations(self) -> float:
        """The squared size of the motion, in standard deviations of its prior; 0 for a camera at rest."""
        return float((self.best.state.camera[4:] ** 2 / self.free.deviations[4:].clip(min=TIED) ** 2).sum())

    def log_evidence_over(self, still: Explanation) -> float:
        """Return the logarithm of the Bayes factor over a camera at rest, in Laplace's approximation (MacKay 2003, ch. 28)."""
        noise = min(self.noise, still.noise)
        ratio = still.about.cost(still.best, noise) - self.about.cost(self.best, noise)
        width = self.free.deviations[4:]
        posterior = self.about.under(self.free).inverse_curvature[10:, 10:]
        narrowed = float(np.linalg.slogdet(posterior / np.outer(width, width))[1])
        return ratio + 0.5 * (narrowed - self.motion_in_deviations)

    @property
    def pose(self) -> State:
        """The pose with the known intrinsics."""
        return self.about.best(self.known)

    @property
    def covariance_by_motion(self) -> Float[Tensor, "6 6"]:
        """The part of the pose's covariance due to the motion, to which the pose adapts."""
        return torch.from_numpy(self.about.under(self.known).covariance_by_last(10))


def _square(a: State, b: State) -> Float[Tensor, "6 6"]:
    """Return the outer product of the right update from one pose to another with itself."""
    turn = a.rotation.T @ b.rotation
    phi = rotation_vector(turn)
    shift = np.concatenate(
        [np.linalg.solve(left_jacobian(phi), a.rotation.T @ (b.position - a.position)), phi]
    )
    return torch.from_numpy(np.outer(shift, shift))
