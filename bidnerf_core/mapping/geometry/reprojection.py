"""Reprojection errors of observed points, their derivatives, and the normal equations of their robust cost."""

from __future__ import annotations

import math
from dataclasses import astuple, dataclass, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.camera import AT_REST, moved_array
from bidnerf_core.geometry import SE3, cauchy_loss, inlier_weight, mad_deviation, rotation_matrix
from bidnerf_core.mapping.geometry.calibration import GIVEN, Calibration
from bidnerf_core.mapping.geometry.observations import ObservedPoints
from bidnerf_core.mapping.geometry.projection import Array, by_update, projected

SCALE = 2.0
"""Scale of the Cauchy loss: the residual, in standard deviations, at which the weight is one half."""
BEHIND = 30.0
"""Residual of a point behind the camera, in standard deviations; its weight is 0."""


@dataclass(frozen=True, eq=False)
class RobustEquations:
    """A robust cost and its derivatives at given values of the unknowns."""

    cost: float
    gradient: Array  # (p,)
    hessian: Array  # (p, p)
    curvature: (
        Array  # (p, p) Hessian of the robust cost itself; ``hessian`` is that of the reweighted squares
    )
    spread: float  # robust standard deviation of the normalized residuals: 1 if the noise is right
    single: Array  # (m, p) gradients of the individual observations' costs
    excess: float  # variance of a residual's gradient over its curvature: 1 for a Gaussian likelihood
    count: float  # effective number of residuals, given that their errors are correlated
    prior: Array  # (p, p) information matrix of the priors

    def weighted(self, share: float) -> RobustEquations:
        """Return the equations with each observation weighted by ``share``, because their errors are correlated."""
        return replace(
            self, cost=share * self.cost, gradient=share * self.gradient, hessian=share * self.hessian,
            curvature=share * self.curvature, count=share * self.count,
        )  # fmt: skip

    def with_prior(self, value: Array, deviations: Array) -> RobustEquations:
        """Add a Gaussian prior about zero on the last unknowns, whose present values are ``value``."""
        first = len(self.gradient) - len(value)
        precision = deviations**-2
        information, gradient = np.zeros_like(self.hessian), self.gradient.copy()
        information[first:, first:] = np.diag(precision)
        gradient[first:] += precision * value
        cost = self.cost + 0.5 * float((precision * value**2).sum())
        hessian, curvature, prior = (
            part + information for part in (self.hessian, self.curvature, self.prior)
        )
        return replace(self, cost=cost, gradient=gradient, hessian=hessian, curvature=curvature, prior=prior)

    @cached_property
    def covariance(self) -> Array:
        """The covariance of an M-estimator, ``A^-1 S A^-1`` with curvature A and scatter S (Huber 1981, 6.3).

        The scatter of a few gradients is far too small in some directions. It is shrunk towards the scatter of identically
        distributed residuals, more strongly the fewer residuals there are per entry (Ledoit and Wolf 2004). The number of
        degrees of freedom is the number of residuals less the unknowns.
        """
        inverse, unknowns = self.inverse_curvature, len(self.gradient)
        alike = unknowns**2 / (unknowns**2 + self.count)
        excess = alike * self.excess * self.count / max(1.0, self.count - unknowns)
        single = (1 - alike) * self.count / (2 * len(self.single)) * self.single.T @ self.single
        with np.errstate(over="ignore", invalid="ignore"):
            found: Array = inverse @ (single + (1 - excess) * self.prior) @ inverse + excess * inverse
            return (found + found.T) / 2

    def covariance_by_last(self, first: int) -> Array:
        """Return the part (6, 6) of the pose's covariance that is due to the unknowns from number ``first`` on.

        The pose is the first six unknowns. All unknowns before ``first`` adapt to the others.
        """
        before, after = self.hessian[:first, :first], self.hessian[:first, first:]
        adapt = -damped_solution(before, 1e-9, after)[:6]
        found: Array = adapt @ self.covariance[first:, first:] @ adapt.T
        return (found + found.T) / 2

    @cached_property
    def inverse_curvature(self) -> Array:
        """The inverse of the curvature: the covariance of the posterior in Laplace's approximation."""
        # With few residuals or many outliers the curvature may be indefinite; well-behaved residuals keep it near the Hessian.
        unit = 1 / np.sqrt(np.diag(self.hessian).clip(min=1e-300))
        values, vectors = np.linalg.eigh(unit[:, None] * self.curvature * unit)
        least = 0.2 * np.linalg.eigvalsh(unit[:, None] * self.hessian * unit)
        inverse = vectors @ np.diag(1 / np.maximum(values, least).clip(min=1e-12)) @ vectors.T
        # Directions that the residuals do not determine overflow, so the covariance is not finite.
        with np.errstate(over="ignore", invalid="ignore"):
            found: Array = unit[:, None] * inverse * unit
            return found


def damped_solution(hessian: Array, damping: float, right: Array) -> Array:
    diagonal = np.diag(hessian).clip(min=1e-12)
    found: Array = np.linalg.solve(hessian + np.diag(damping * diagonal), right)
    return found


@dataclass(frozen=True, eq=False)
class State:
    """The unknowns: the rig's pose, and the camera parameters that may be estimated along with it."""

    rotation: Array  # (3, 3) R_world_rig
    position: Array  # (3,) metres
    camera: (
        Array  # (11,) calibration in the order of ``Calibration``, and motion from the first row to the last
    )

    @staticmethod
    def of(T: SE3, calibration: Calibration = GIVEN, motion: Tensor = AT_REST) -> State:
        camera = np.concatenate([np.array(astuple(calibration)), motion.numpy()])
        return State(T.rotation.numpy(), T.translation.numpy(), camera)

    @property
    def calibration(self) -> Calibration:
        return Calibration(*self.camera[:5].tolist())

    @property
    def motion(self) -> Float[Tensor, "6"]:
        return torch.from_numpy(self.camera[5:].copy())

    def retracted(self, step: Array, free: Array) -> State:
        """Return the state after a step of the pose and of the ``free`` camera parameters."""
        camera = self.camera.copy()
        camera[free] += step[6:]
        # To first order, a translation along the camera's axes equals that of the exponential map.
        position = self.position + self.rotation @ step[:3]
        return State(self.rotation @ rotation_matrix(step[3:6]), position, camera)

    def pose(self) -> SE3:
        return SE3(torch.from_numpy(self.rotation), torch.from_numpy(self.position)).polished()


@dataclass(frozen=True, eq=False)
class LinearizedErrors:
    """Reprojection errors in pixels, linearized about a state; they do not depend on the noise."""

    state: State
    front: Array  # (m,) whether the point is in front of the camera
    off: Array  # (m, 2) projection minus observation
    jacobian: Array  # (m, 2, p)


class ReprojectionErrors:
    """Reprojection errors of observed points, and the normal equations of their robust cost."""

    def __init__(self, data: ObservedPoints, start: SE3) -> None:
        self._points = data.points.numpy()
        self._rotation, self._translation = data.rotation.numpy(), data.translation.numpy()
        self._exposure_times = data.exposure_times.numpy()
        self._turned = bool((self._rotation != np.eye(3)).any())
        self._focal = data.focal.numpy()
        self._observed = data.image.numpy() * self._focal[:, None]
        self._variance = data.point_variance(start).numpy()  # it hardly changes on the way

    def linearized(self, state: State, free: Array) -> LinearizedErrors:
        """Return the errors at a state and their Jacobian with respect to the pose and the ``free`` camera parameters."""
        rig = (self._points - state.position) @ state.rotation
        motion = state.camera[5:]
        if motion.any():
            rig = moved_array(rig, self._exposure_times, motion)
        turned = np.einsum("mij,mj->mi", self._rotation, rig) if self._turned else rig
        seen, focal = projected(turned + self._translation), self._focal[:, None]
        log_focal, shift, radial = state.camera[0], state.camera[1:3], state.camera[3]
        half = 0.5 * state.camera[4]  # of the logarithm of the stretch
        stretch = np.exp([half, -half])
        bend = radial * (seen.flat**2).sum(1, keepdims=True)
        bent = seen.flat * (1 + bend) * focal * math.exp(log_focal) * stretch
        by_point = seen.by_point(self._focal * math.exp(log_focal))
        if radial:
            across = 2 * radial * seen.flat[:, :, None] * seen.flat[:, None]
            by_point = (np.eye(2) * (1 + bend)[..., None] + across) @ by_point
        by_point = by_point * stretch[:, None]
        by_rig = by_point @ self._rotation if self._turned else by_point
        by_pose = by_update(by_rig, rig)
        off = bent + focal * shift - self._observed
        if not len(free):
            return LinearizedErrors(state, seen.front, off, by_pose)
        by_shift = np.eye(2)[..., None] * self._focal
        distorted = seen.flat * (seen.flat**2).sum(1, keepdims=True) * focal * math.exp(log_focal) * stretch
        by_motion = np.moveaxis(by_pose * self._exposure_times[:, None, None], -1, 0)
        by_stretch = bent * np.array([0.5, -0.5])
        by_camera = [bent, by_shift[0].T, by_shift[1].T, distorted, by_stretch, *by_motion]
        jacobian = np.concatenate([by_pose, np.stack([by_camera[i] for i in free], axis=-1)], axis=-1)
        return LinearizedErrors(state, seen.front, off, jacobian)

    def system(self, here: LinearizedErrors, noise: float) -> RobustEquations:
        """Return the normal equations for keypoints with this noise (pixels)."""
        deviation = np.sqrt(noise**2 + self._variance)[:, None]
        residual = np.where(here.front[:, None], here.off / deviation, BEHIND)
        squared = (residual**2).sum(1)
        weight = here.front * inlier_weight(squared, SCALE)
        jacobian = here.jacobian / deviation[..., None]
        single = ((weight[:, None] * residual)[:, None] @ jacobian)[:, 0]
        weighted = (jacobian * np.sqrt(weight)[:, None, None]).reshape(-1, jacobian.shape[-1])
        hessian = weighted.T @ weighted
        cost = cauchy_loss(squared, SCALE)
        # d(w r)/dr = w I - 2 w^2 r r^T / c^2 for w = 1 / (1 + r^2 / c^2).
        curvature = hessian - 2 / SCALE**2 * single.T @ single
        spare = max(1.0, residual.size - jacobian.shape[-1]) / residual.size
        spread = mad_deviation(residual) / spare**0.5
        gradients = weight**2 * squared  # along both axes together
        excess = 0.5 * float(gradients.mean() / max(0.1, (weight - gradients / SCALE**2).mean()))
        return RobustEquations(
            cost, single.sum(0), hessian, curvature, spread, single, excess, residual.size, 0 * hessian
        )
