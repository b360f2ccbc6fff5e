"""Resection: estimate the pose of a camera or a rig from known points, by robust Levenberg-Marquardt in pixels.

The calibration of the camera, and its motion while the rows of a rolling shutter are exposed, may be estimated along with
the pose, as far as priors leave them open. The general solver on batches of poses is ``localization/solvers/levenberg_marquardt``.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.camera.rolling_shutter import STILL, MotionPrior
from bidnerf_core.geometry.se3 import SE3
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
"""Largest number of steps; from a good start, four or five suffice."""
SMALL_STEP = 1e-4
"""Squared length of a step, in standard deviations of the unknowns, below which the iteration has converged."""
NOISE_TOLERANCE = 0.01
"""Relative change of the estimated noise below which it has converged."""
LEAST_NOISE = 0.05
"""Lower limit of the estimated noise, pixels: no detector is more accurate."""


@dataclass(frozen=True, eq=False)
class ReprojectionFit:
    """A pose with its uncertainty, and the calibration and the motion that were estimated with it."""

    T_world_rig: SE3
    calibration: Calibration
    motion: Float[Tensor, "6"]  # from the first row of the image to the last, see ``rolling_shutter``
    noise: float  # pixels: robust standard deviation of a residual along each axis
    # Of the right update (translation, rotation), with the uncertainty of the calibration and of the motion.
    covariance: Float[Tensor, "6 6"]
    calibration_deviations: Float[Tensor, "5"]  # standard deviations, in the order of ``Calibration``
    system: RobustEquations  # at the minimum
    first_of_motion: int  # number of the first unknown that belongs to the motion

    @cached_property
    def covariance_by_motion(self) -> Float[Tensor, "6 6"]:
        """The part of the pose's covariance due to the motion, to which the other unknowns adapt."""
        return torch.from_numpy(self.system.covariance_by_last(self.first_of_motion))

    @cached_property
    def motion_posterior(self) -> Float[Tensor, "k k"]:
        """The covariance of the motion, from the curvature of the cost; 0x0 for a camera at rest."""
        first = self.first_of_motion
        return torch.from_numpy(self.system.inverse_curvature[first:, first:].copy())

    def log_occam_factor(self, prior: MotionPrior) -> float:
        """Return the logarithm of the Occam factor of an estimated motion: how much the observations narrow its prior.

        The likelihood of the fit times this factor is the evidence for a motion (MacKay 2003, ch. 28), in Laplace's
        approximation; the evidence for no motion is the likelihood of the fit without one.
        """
        narrowed = self.motion_posterior / torch.outer(prior.deviations, prior.deviations)
        return 0.5 * (float(torch.logdet(narrowed)) - self.motion_in_deviations(prior))

    def motion_in_deviations(self, prior: MotionPrior) -> float:
        """Return the squared size of the motion, in standard deviations of its prior."""
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
    """Minimize the Cauchy loss of the reprojection errors, in standard deviations of keypoint and landmark together.

    ``noise`` is a first guess at the keypoints' noise (pixels), which is re-estimated after every accepted step until it
    settles. ``calibration`` is where its estimation starts; parameters that ``prior`` leaves out stay there.
    ``correlation`` is the number of observations that count as one, because their errors are correlated: it weighs them
    against the priors and scales the covariance. ``motion``: how far the camera may have moved while its rows were exposed.
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
    """Minimize the robust cost with a prior about zero on the parameters of the camera.

    Returns the errors at the minimum, the equations there with the prior, and the noise (pixels). ``deviations`` (11,): those of
    the prior; parameters with 0 stay where ``start`` has them. Unless the noise is known, it is estimated too, as in ``resect``.
    ``steps``: how many are taken at most.
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
    """Return the logarithm of the likelihood ratio of the observations, with one fit to them over another.

    Both are compared by the loss of ``resect``, with the deviations of the fit with less noise, which is the better
    explanation: those of points depend on the pose, and larger ones would make large residuals more likely at no cost.
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
    """Return the logarithm of the Bayes factor of a motion against none."""
    return log_likelihood_ratio(data, moving, still, correlation) + moving.log_occam_factor(motion)


def _cost(errors: ReprojectionErrors, fit: ReprojectionFit, noise: float) -> float:
    """Return the loss of ``resect``, without priors."""
    state = State.of(fit.T_world_rig, fit.calibration, fit.motion)
    return errors.system(errors.linearized(state, np.arange(0)), noise).cost
