"""Resection: estimate the pose of a camera or a rig from known points, by robust Levenberg-Marquardt in pixels.

The calibration of the camera may be estimated along with the pose, as far as a prior leaves it open. The arrays
are small and the steps many, so everything is NumPy; the general solver on batches of poses is
``localization/solvers/levenberg_marquardt``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.mapping.calibration import FIXED, GIVEN, Calibration, CalibrationPrior
from bidnerf_core.mapping.observed_points import ObservedPoints
from bidnerf_core.robust import MAD_TO_SIGMA
from bidnerf_core.rotations import rotation_of
from bidnerf_core.se3 import SE3

Array = np.ndarray

RESECTION_STEPS = 20
"""Largest number of steps; from a good start, four or five suffice."""
SMALL_STEP = 1e-4
"""Squared length of a step, in standard deviations of the unknowns, below which the iteration has converged."""
NOISE_TOLERANCE = 0.01
"""Relative change of the estimated noise below which it has converged."""
LEAST_NOISE = 0.05
"""Lower limit of the estimated noise, pixels: no detector is more accurate."""
SCALE = 2.0
"""Scale of the Cauchy loss: the residual, in standard deviations, whose weight is one half."""
BEHIND = 30.0
"""Residual of a point behind the camera, in standard deviations; its weight is 0."""


@dataclass(frozen=True, eq=False)
class ReprojectionFit:
    """A pose with its uncertainty, and the calibration that was estimated with it."""

    T_world_rig: SE3
    calibration: Calibration
    noise: float  # pixels: standard deviation of a residual along each axis, robustly
    covariance: Float[
        Tensor, "6 6"
    ]  # of the right update (translation, rotation), with the uncertainty of the calibration
    calibration_deviations: Float[Tensor, "4"]  # standard deviations, in the order of ``Calibration``
    slope: Float[Tensor, "6 4"]  # right update of the pose by a unit of each parameter of the calibration


def resect(
    data: ObservedPoints,
    start: SE3,
    noise: float,
    prior: CalibrationPrior = FIXED,
    calibration: Calibration = GIVEN,
    correlation: float = 1.0,
) -> ReprojectionFit:
    """Minimize the Cauchy loss of the reprojection errors in standard deviations of keypoint and landmark together.

    ``noise`` is a first guess at the keypoints' noise (pixels), which is re-estimated after every accepted step until it
    settles. ``calibration`` is where its estimation starts; parameters that ``prior`` leaves out stay there.
    ``correlation`` is the number of observations that count as one, because their errors are correlated: it weighs them
    against the prior and scales the covariance.
    """
    residuals, free = _Residuals(data, start), prior.deviations.numpy().nonzero()[0]

    def equations(here: _Linearization, noise: float) -> _System:
        return residuals.system(here, noise).weighted(1 / correlation).with_prior(here.state, prior)

    here = residuals.linearized(_State.of(start, calibration), free)
    system, damping = equations(here, noise), 1e-6
    for _ in range(RESECTION_STEPS):
        step = -_solved(system.hessian, damping, system.gradient)
        moved = residuals.linearized(here.state.retracted(step, free), free)
        tried = equations(moved, noise)
        size = float(step @ system.hessian @ step)
        if not tried.cost <= system.cost:
            damping = max(10 * damping, 1e-4)
            if size < SMALL_STEP or damping > 1e8:
                break
            continue
        here, system, damping = moved, tried, damping / 10
        better = max(LEAST_NOISE, noise * tried.spread)
        settled = abs(better / noise - 1) < NOISE_TOLERANCE
        if not settled:
            noise = better
            system = equations(here, noise)
        elif size < SMALL_STEP:
            break
    covariance = system.covariance()
    deviations = np.zeros(4)
    deviations[free] = np.sqrt(np.diag(covariance)[6:].clip(min=0))
    state = here.state
    return ReprojectionFit(
        state.pose(),
        Calibration(*state.calibration.tolist()),
        noise,
        torch.from_numpy(covariance[:6, :6].copy()),
        torch.from_numpy(deviations),
        torch.from_numpy(residuals.slope(state, noise)),
    )


def log_likelihood_ratio(
    data: ObservedPoints, fit: ReprojectionFit, other: ReprojectionFit, correlation: float = 1.0
) -> float:
    """Return the logarithm of how many times as likely the observations are with one fit to them as with another.

    Both are compared by the loss of ``resect``, with the deviations that the one with less noise, the better explanation, has:
    those of the points depend on the pose, and larger ones would make residuals less unlikely at no price.
    """
    better = min(fit, other, key=lambda fit: fit.noise)
    residuals, none_free = _Residuals(data, better.T_world_rig), np.arange(0)
    states = [_State.of(f.T_world_rig, f.calibration) for f in (other, fit)]
    costs = [residuals.system(residuals.linearized(s, none_free), better.noise).cost for s in states]
    return (costs[0] - costs[1]) / correlation


@dataclass(frozen=True, eq=False)
class _State:
    """The unknowns: the rig's pose and the calibration."""

    rotation: Array  # (3, 3) R_world_rig
    position: Array  # (3,) metres
    calibration: Array  # (4,) in the order of ``Calibration``

    @staticmethod
    def of(T: SE3, calibration: Calibration) -> _State:
        numbers = [getattr(calibration, f.name) for f in fields(calibration)]
        return _State(T.rotation.numpy(), T.translation.numpy(), np.array(numbers))

    def retracted(self, step: Array, free: Array) -> _State:
        calibration = self.calibration.copy()
        calibration[free] += step[6:]
        # To first order, moving along the camera's axes equals the exponential map's translation.
        position = self.position + self.rotation @ step[:3]
        return _State(self.rotation @ rotation_of(step[3:6]), position, calibration)

    def pose(self) -> SE3:
        return SE3(torch.from_numpy(self.rotation), torch.from_numpy(self.position)).normalized()


@dataclass(frozen=True, eq=False)
class _System:
    cost: float
    gradient: Array  # (p,)
    hessian: Array  # (p, p)
    curvature: Array  # (p, p) of the robust cost itself; the Hessian is that of the reweighted squares
    scatter: Array  # (p, p) of the gradients of single observations and priors
    spread: float  # residuals in standard deviations, robustly: 1 where the noise is right

    def weighted(self, share: float) -> _System:
        return _System(
            share * self.cost, share * self.gradient, share * self.hessian, share * self.curvature,
            share * self.scatter, self.spread,
        )  # fmt: skip

    def with_prior(self, state: _State, prior: CalibrationPrior) -> _System:
        """Add the prior of the free parameters, which is Gaussian."""
        deviations = prior.deviations.numpy()
        free = deviations.nonzero()[0]
        if not len(free):
            return self
        precision = deviations[free] ** -2
        value = state.calibration[free]
        information, gradient = np.zeros_like(self.hessian), self.gradient.copy()
        information[6:, 6:] = np.diag(precision)
        gradient[6:] += precision * value
        cost = self.cost + 0.5 * float((precision * value**2).sum())
        return _System(
            cost, gradient, self.hessian + information, self.curvature + information,
            self.scatter + information, self.spread,
        )  # fmt: skip

    def covariance(self) -> Array:
        """Return the covariance of an M-estimator, ``A^-1 S A^-1`` with curvature A and scatter S (Huber 1981, 6.3)."""
        # With few residuals or many outliers the curvature may be indefinite; well-behaved residuals keep it near the Hessian.
        unit = 1 / np.sqrt(np.diag(self.hessian).clip(min=1e-300))
        values, vectors = np.linalg.eigh(unit[:, None] * self.curvature * unit)
        least = 0.2 * np.linalg.eigvalsh(unit[:, None] * self.hessian * unit)
        inverse = vectors @ np.diag(1 / np.maximum(values, least).clip(min=1e-12)) @ vectors.T
        # What the residuals do not determine at all overflows; a covariance that is not finite says so.
        with np.errstate(over="ignore", invalid="ignore"):
            inverse = unit[:, None] * inverse * unit
            found: Array = inverse @ self.scatter @ inverse
            return (found + found.T) / 2


@dataclass(frozen=True, eq=False)
class _Linearization:
    """Reprojection errors in pixels about a state; they do not depend on the noise, which may change without them."""

    state: _State
    front: Array  # (m,) whether the point is before the camera
    off: Array  # (m, 2) projection minus observation
    jacobian: Array  # (m, 2, p)


class _Residuals:
    """Reprojection errors of observed points, and the normal equations of their robust cost."""

    def __init__(self, data: ObservedPoints, start: SE3) -> None:
        self._points = data.points.numpy()
        self._rotation, self._translation = data.rotation.numpy(), data.translation.numpy()
        self._turned = bool((self._rotation != np.eye(3)).any())
        self._focal = data.focal.numpy()[:, None]
        self._observed = data.image.numpy() * self._focal
        self._variance = data.point_variance(start).numpy()  # it hardly changes on the way

    def linearized(self, state: _State, free: Array) -> _Linearization:
        rig = (self._points - state.position) @ state.rotation
        turned = np.einsum("mij,mj->mi", self._rotation, rig) if self._turned else rig
        local = turned + self._translation
        front = local[:, 2] > 1e-9
        z = np.where(front, local[:, 2], 1)[:, None]
        flat = local[:, :2] / z
        log_focal, shift, radial = state.calibration[0], state.calibration[1:3], state.calibration[3]
        bend = radial * (flat**2).sum(1, keepdims=True)
        scale = self._focal * math.exp(log_focal)
        projected = flat * (1 + bend) * scale + self._focal * shift
        jacobian = self._jacobian(rig, flat, z, scale, radial, bend, free)
        return _Linearization(state, front, projected - self._observed, jacobian)

    def system(self, here: _Linearization, noise: float) -> _System:
        """Return the normal equations for keypoints of this noise (pixels)."""
        deviation = np.sqrt(noise**2 + self._variance)[:, None]
        residual = np.where(here.front[:, None], here.off / deviation, BEHIND)
        squared = (residual**2).sum(1)
        weight = here.front / (1 + squared / SCALE**2)
        jacobian = here.jacobian / deviation[..., None]
        single = ((weight[:, None] * residual)[:, None] @ jacobian)[:, 0]
        weighted = (jacobian * np.sqrt(weight)[:, None, None]).reshape(-1, jacobian.shape[-1])
        hessian, scatter = weighted.T @ weighted, single.T @ single
        cost = 0.5 * SCALE**2 * float(np.log1p(squared / SCALE**2).sum())
        # d(w r)/dr = w I - 2 w^2 r r^T / c^2 for w = 1 / (1 + r^2 / c^2).
        curvature = hessian - 2 / SCALE**2 * scatter
        spread = _spread(residual, jacobian.shape[-1])
        return _System(cost, single.sum(0), hessian, curvature, scatter, spread)

    def slope(self, state: _State, noise: float) -> Array:
        """Return how the pose that fits best follows a change of the calibration, (6, 4)."""
        hessian = self.system(self.linearized(state, np.arange(4)), noise).hessian
        return -_solved(hessian[:6, :6], 1e-9, hessian[:6, 6:])

    def _jacobian(
        self, rig: Array, flat: Array, z: Array, scale: Array, radial: float, bend: Array, free: Array
    ) -> Array:
        """Return the derivative (m, 2, p) of the projection in pixels by a right update and by the free calibration."""
        x, y = flat[:, 0], flat[:, 1]
        zero, one = np.zeros_like(x), np.ones_like(x)
        by_rig = np.stack([one, zero, -x, zero, one, -y], axis=1).reshape(-1, 2, 3) * (scale / z)[..., None]
        if radial:
            by_rig = (
                np.eye(2) * (1 + bend)[..., None] + 2 * radial * flat[:, :, None] * flat[:, None]
            ) @ by_rig
        if self._turned:
            by_rig = by_rig @ self._rotation
        # A point of the rig's frame moves by -rho + p x phi under T exp(rho, phi), and r (p x phi) = (r x p) phi.
        by_pose = np.concatenate([-by_rig, _cross(by_rig, rig[:, None])], axis=-1)
        if not len(free):
            return by_pose
        focal = self._focal[:, 0]
        by_calibration = [
            flat * (1 + bend) * scale,
            np.stack([focal, zero], axis=1),
            np.stack([zero, focal], axis=1),
            flat * (flat**2).sum(1, keepdims=True) * scale,
        ]
        return np.concatenate([by_pose, np.stack([by_calibration[i] for i in free], axis=-1)], axis=-1)


def _spread(residual: Array, unknowns: int) -> float:
    """Return a robust standard deviation along an axis, corrected for the number of unknowns that were fitted."""
    spare = max(1.0, residual.size - unknowns) / residual.size
    return MAD_TO_SIGMA * _median(np.abs(residual).ravel()) / spare**0.5


def _cross(a: Array, b: Array) -> Array:
    """Return ``np.cross`` of vectors along the last axis, in a fifth of its time for small arrays."""
    (a0, a1, a2), (b0, b1, b2) = np.moveaxis(a, -1, 0), np.moveaxis(b, -1, 0)
    return np.stack([a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0], axis=-1)


def _median(values: Array) -> float:
    """Return ``np.median`` of finite values, without the time that its checks take."""
    half, odd = divmod(len(values), 2)
    ordered = np.partition(values, (half - 1 + odd, half))
    return float(ordered[half]) if odd else float(0.5 * (ordered[half - 1] + ordered[half]))


def _solved(hessian: Array, damping: float, right: Array) -> Array:
    diagonal = np.diag(hessian).clip(min=1e-12)
    found: Array = np.linalg.solve(hessian + np.diag(damping * diagonal), right)
    return found
