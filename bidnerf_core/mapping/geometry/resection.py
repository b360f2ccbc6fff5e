"""Resection: estimate the pose of a camera or a rig from known points, by robust Levenberg-Marquardt in pixels.

The camera's calibration, and its motion during a rolling shutter's readout, may be estimated along with the pose, under priors.
The general solver for batches of poses is ``localization/solvers/levenberg_marquardt``.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.camera import STILL, MotionPrior
from bidnerf_core.geometry import SE3
from bidnerf_core.mapping.geometry.calibration import FIXED, GIVEN, Calibration, CalibrationPrior
from bidnerf_core.mapping.geometry.observations import ObservedPoints
from bidnerf_core.mapping.geometry.projection import Array
from bidnerf_core.mapping.geometry.reprojection import (
    LinearizedErrors,
    ReprojectionErrors,
    RobustEquations,
    State,
    damped_solution,
)

RESECTION_STEPS = 20
"""Maximum number of steps; from a good start, four or five suffice."""
SMALL_STEP = 1e-4
"""Squared length of a step, in standard deviations of the unknowns, at which the iteration has converged."""
NOISE_TOLERANCE = 0.01
"""Relative change of the estimated noise at which it has converged."""
LEAST_NOISE = 0.05
"""Lower limit of the estimated noise (pixels): no detector is more accurate."""


@dataclass(frozen=True, eq=False)
class ReprojectionFit:
    """An estimated pose with its covariance, and the calibration and motion estimated along with it."""

    T_world_rig: SE3
    calibration: Calibration
    motion: Float[Tensor, "6"]  # from the first row of the image to the last, see ``rolling_shutter``
    noise: float  # pixels: robust standard deviation of a residual along each axis
    # Covariance of the right update (translation, rotation), including uncertainty of the calibration and the motion.
    covariance: Float[Tensor, "6 6"]
    calibration_deviations: Float[Tensor, "5"]  # standard deviations, in the order of ``Calibration``
    system: RobustEquations  # at the minimum
    first_of_motion: int  # number of the first unknown that belongs to the motion

    @cached_property
    def covariance_by_motion(self) -> Float[Tensor, "6 6"]:
        """The part of the pose's covariance that is due to the motion, to which the other unknowns adapt."""
        return torch.from_numpy(self.system.covariance_by_last(self.first_of_motion))

    @cached_property
    def motion_posterior(self) -> Float[Tensor, "k k"]:
        """The covariance of the motion, from the curvature of the cost; 0x0 for a static camera."""
        first = self.first_of_motion
        return torch.from_numpy(self.system.inverse_curvature[first:, first:].copy())

    def log_occam_factor(self, prior: MotionPrior) -> float:
        """Return the log Occam factor of an estimated motion: how much the observations narrow its prior.

        In Laplace's approximation, the evidence for a motion is the likelihood of the fit times this factor (MacKay 2003,
        ch. 28); the evidence for a static camera is the likelihood of the fit without motion.
        """
        narrowed = self.motion_posterior / torch.outer(prior.deviations, prior.deviations)
        return 0.5 * (float(torch.logdet(narrowed)) - self.motion_in_deviations(prior))

    def motion_in_deviations(self, prior: MotionPrior) -> float:
        """Return the squared norm of the motion, in standard deviations of its prior."""
        return float((self.motion / prior.deviations).square().sum())


def resect(
    data: ObservedPoints,
    start: SE3,
    noise: float,
    prior: CalibrationPrior = FIXED,
    calibration: Calibration = GIVEN,
    correlation: float = 1.0,
    motion: MotionPrior = STILL,
) -> ReprojectionFit:
    """Minimize the Cauchy loss of the reprojection errors, normalized by the noise of keypoints and landmarks.

    ``noise`` is a first guess at the keypoints' noise (pixels), which is re-estimated after every accepted step until it
    converges. ``calibration`` is the initial value; parameters that ``prior`` does not free keep it. ``correlation`` is the
    number of observations that count as one because their errors are correlated: it weights them against the priors and
    scales the covariance. ``motion`` is the prior on the camera's motion during the readout.
    """
    errors = ReprojectionErrors(data, start)
    deviations = torch.cat([prior.deviations, motion.deviations]).numpy()
    here, system, noise = minimized(errors, State.of(start, calibration), deviations, noise, correlation)
    free = torch.from_numpy(deviations.nonzero()[0])
    state, covariance = here.state, torch.from_numpy(system.covariance)
    of_calibration = covariance.new_zeros(11)
    of_calibration[free] = covariance.diagonal()[6:].clamp(min=0).sqrt()
    return ReprojectionFit(
        state.pose(), state.calibration, state.motion, noise, covariance[:6, :6].clone(), of_calibration[:5].clone(),
        system, 6 + int(np.count_nonzero(deviations[:5])),
    )  # fmt: skip


def minimized(
    errors: ReprojectionErrors,
    start: State,
    deviations: Array,
    noise: float,
    correlation: float = 1.0,
    known_noise: bool = False,
    steps: int = RESECTION_STEPS,
) -> tuple[LinearizedErrors, RobustEquations, float]:
    """Minimize the robust cost with a zero-mean prior on the camera parameters.

    ``deviations`` (11,) are the prior's; parameters with 0 keep their values of ``start``. Unless the noise is known, it is
    estimated too, as in ``resect``. At most ``steps`` steps are taken. Returns the errors at the minimum, the equations there
    including the prior, and the noise (pixels).
    """
    free = deviations.nonzero()[0]

    def equations(here: LinearizedErrors, noise: float) -> RobustEquations:
        system = errors.system(here, noise).weighted(1 / correlation)
        return system.with_prior(here.state.camera[free], deviations[free])

    here = errors.linearized(start, free)
    system, damping = equations(here, noise), 1e-6
    for _ in range(steps):
        step = -damped_solution(system.hessian, damping, system.gradient)
        moved = errors.linearized(here.state.retracted(step, free), free)
        tried = equations(moved, noise)
        size = float(step @ system.hessian @ step)
        if not tried.cost <= system.cost:
            damping = max(10 * damping, 1e-4)
            if size < SMALL_STEP or damping > 1e8:
                break
            continue
        here, system, damping = moved, tried, damping / 10
        better = noise if known_noise else max(LEAST_NOISE, noise * tried.spread)
        if abs(better / noise - 1) >= NOISE_TOLERANCE:
            noise = better
            system = equations(here, noise)
        elif size < SMALL_STEP:
            break
    return here, system, noise


def log_likelihood_ratio(
    data: ObservedPoints, fit: ReprojectionFit, other: ReprojectionFit, correlation: float = 1.0
) -> float:
    """Return the log-likelihood ratio of the observations under ``fit`` over ``other``.

    Both are evaluated by the loss of ``resect``, with the standard deviations of the fit with less noise: the points'
    deviations depend on the pose, and a worse fit's larger ones would make its large residuals more likely at no cost.
    """
    better = min(fit, other, key=lambda fit: fit.noise)
    errors = ReprojectionErrors(data, better.T_world_rig)
    costs = [_cost(errors, each, better.noise) for each in (other, fit)]
    return (costs[0] - costs[1]) / correlation


def log_motion_evidence(
    data: ObservedPoints,
    moving: ReprojectionFit,
    still: ReprojectionFit,
    motion: MotionPrior,
    correlation: float,
) -> float:
    """Return the log Bayes factor of a moving over a static camera."""
    return log_likelihood_ratio(data, moving, still, correlation) + moving.log_occam_factor(motion)


def _cost(errors: ReprojectionErrors, fit: ReprojectionFit, noise: float) -> float:
    """Return the loss of ``resect``, without priors."""
    state = State.of(fit.T_world_rig, fit.calibration, fit.motion)
    return errors.system(errors.linearized(state, np.arange(0)), noise).cost
