"""The robust cost of reprojection errors near a fit, to second order: fits under other priors follow by linear algebra.

The unknowns are the pose and all parameters of the camera. A hypothesis about the camera is a Gaussian prior on these
parameters; one that ties a parameter to a value has no width there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bidnerf_core.mapping.geometry.projection import Array
from bidnerf_core.mapping.geometry.reprojection import (
    LinearizedErrors,
    ReprojectionErrors,
    RobustEquations,
    State,
    damped_solution,
)
from bidnerf_core.mapping.geometry.resection import LEAST_NOISE

EVERY = np.arange(10)
"""All parameters of a camera: calibration, and motion from the first row to the last."""
TIED = 1e-9
"""Deviation of a prior without width: far below what observations resolve, and far above what rounding does."""


@dataclass(frozen=True, eq=False)
class CameraPrior:
    """A hypothesis about a camera: Gaussian distributions of its parameters, in the order of ``State.camera``."""

    mean: Array  # (10,)
    deviations: Array  # (10,); 0 for parameters that are known


class QuadraticFit:
    """The cost about a state, to second order in a right update of the pose and in the camera's parameters."""

    def __init__(self, errors: ReprojectionErrors, state: State, noise: float, correlation: float) -> None:
        """``noise`` is that of keypoints (pixels), ``correlation`` the number of observations that count as one."""
        self.state, self._noise, self._errors, self._correlation = state, noise, errors, correlation
        self._equations = errors.system(errors.linearized(state, EVERY), noise).weighted(1 / correlation)

    def under(self, prior: CameraPrior) -> RobustEquations:
        """Return the normal equations with a prior, whose inverse curvature is the posterior's covariance."""
        return self._equations.with_prior(self.state.camera - prior.mean, prior.deviations.clip(min=TIED))

    def best(self, prior: CameraPrior) -> State:
        """Return the most probable state under a prior, by one Gauss-Newton step."""
        equations = self.under(prior)
        return self.state.retracted(-damped_solution(equations.hessian, 1e-9, equations.gradient), EVERY)

    def at_best(self, prior: CameraPrior) -> LinearizedErrors:
        """Return the exact errors at ``best``, linearized in what the prior leaves open."""
        return self._errors.linearized(self.best(prior), prior.deviations.nonzero()[0])

    def noise(self, here: LinearizedErrors) -> float:
        """Return the noise of keypoints (pixels) that errors show."""
        return max(LEAST_NOISE, self._noise * self._errors.system(here, self._noise).spread)

    def cost(self, here: LinearizedErrors, noise: float) -> float:
        """Return the cost of errors, for keypoints of this noise (pixels)."""
        return self._errors.system(here, noise).cost / self._correlation
