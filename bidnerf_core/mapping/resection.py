"""Resection: estimate the pose of a camera or a rig from known points, by robust Levenberg-Marquardt in pixels."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.se3 import SE3, skew

RESECTION_STEPS = 20
"""Largest number of steps; from a good start, four or five suffice."""
FIRM = 0.05**2
"""Squared length of a step, in standard deviations of the pose, below which the iteration has converged. Much shorter steps
need not lower the cost, since the gradient leaves out that the deviations of landmarks depend on the pose.
"""
SETTLED = 0.01
"""Relative change of the estimated noise below which it has converged."""
LEAST_NOISE = 0.05
"""Lower limit of the estimated noise, pixels: no detector is more accurate."""
SCALE = 2.0
"""Scale of the Cauchy loss: the residual, in standard deviations, whose weight is one half."""


@dataclass(frozen=True, eq=False)
class ObservedPoints:
    """Points of the world and their observations by the cameras of a rig. Float64."""

    points: Float[Tensor, "m 3"]  # metres, world
    deviations: Float[Tensor, "m 2"]  # metres, of the points, across and along ``directions``
    directions: Float[Tensor, "m 3"]  # unit, world
    image: Float[Tensor, "m 2"]  # observed, on the plane z = 1 of the camera
    focal: Float[Tensor, "m"]  # pixels
    depth: Float[Tensor, "m"]  # metres, 0 where none was measured
    rotation: Float[Tensor, "m 3 3"]  # R_camera_rig
    translation: Float[Tensor, "m 3"]  # t_camera_rig, metres

    def __len__(self) -> int:
        return len(self.points)

    def __getitem__(self, index: Tensor) -> ObservedPoints:
        return ObservedPoints(*(getattr(self, name)[index] for name in (f.name for f in fields(self))))

    def with_focal(self, factor: float) -> ObservedPoints:
        """Return the same pixels, seen by cameras whose focal lengths are ``factor`` times as long."""
        return replace(self, image=self.image / factor, focal=self.focal * factor)

    def in_camera(self, T_world_rig: SE3) -> Float[Tensor, "m 3"]:
        """Return each point in the frame of the camera that observed it."""
        rig = T_world_rig.inverse().apply(self.points)
        return (self.rotation @ rig[..., None])[..., 0] + self.translation

    def residuals(self, T_world_rig: SE3) -> Float[Tensor, "m 2"]:
        """Return projection minus observation, pixels; infinite for points behind the camera."""
        local = self.in_camera(T_world_rig)
        z = local[:, 2:]
        off = (local[:, :2] / torch.where(z > 0, z, 1) - self.image) * self.focal[:, None]
        return torch.where(z > 0, off, torch.inf)

    def normalized_residuals(self, T_world_rig: SE3, noise: float) -> Float[Tensor, "m 2"]:
        """Return the residuals in standard deviations, which combine the keypoints' ``noise`` (pixels) with the points'."""
        z = self.in_camera(T_world_rig)[:, 2]
        deviation = _deviation(self, T_world_rig, self.focal / torch.where(z > 0, z, 1), noise)
        return self.residuals(T_world_rig) / deviation[:, None]


@dataclass(frozen=True, eq=False)
class ReprojectionFit:
    """A pose with its uncertainty and, if it was estimated, a factor on the focal length."""

    T_world_rig: SE3
    focal_factor: float  # true over given focal length; 1 if it was not estimated
    noise: float  # pixels: standard deviation of a residual along each axis, robustly
    covariance: Float[
        Tensor, "p p"
    ]  # of the right update (translation, rotation) and of the logarithm of the factor


def resect(
    data: ObservedPoints, start: SE3, noise: float, free_focal: bool = False, focal_factor: float = 1.0
) -> ReprojectionFit:
    """Minimize the Cauchy loss of the reprojection errors in standard deviations of keypoint and landmark together.

    ``noise`` is a first guess at the keypoints' noise (pixels), which is re-estimated after every accepted step until it
    settles. ``focal_factor`` multiplies the focal lengths; with ``free_focal`` it is estimated too, from that start.
    """
    T, log_factor, damping = start, torch.tensor(focal_factor, dtype=torch.float64).log(), 1e-4
    system = _linearized(data, T, log_factor, noise, free_focal)
    for _ in range(RESECTION_STEPS):
        step = -_solved(system.hessian, damping, system.gradient)
        T_new = T.retract(step[:6]).normalized()
        factor_new = log_factor + step[6] if free_focal else log_factor
        tried = _linearized(data, T_new, factor_new, noise, free_focal)
        size = float(step @ system.hessian @ step)
        if tried.cost <= system.cost:
            T, log_factor, damping, system = T_new, factor_new, max(1e-10, damping / 10), tried
            better = max(LEAST_NOISE, noise * system.spread)
            settled = abs(better / noise - 1) < SETTLED
            if not settled:
                noise = better
                system = _linearized(data, T, log_factor, noise, free_focal)
            elif size < FIRM:
                break
        elif size < FIRM or damping > 1e8:
            break
        else:
            damping *= 10
    covariance = _sandwich(system)
    return ReprojectionFit(T, float(log_factor.exp()), noise, covariance)


@dataclass(frozen=True, eq=False)
class _System:
    cost: float
    gradient: Float[Tensor, "p"]
    hessian: Float[Tensor, "p p"]
    curvature: Float[
        Tensor, "p p"
    ]  # of the robust cost itself; the Hessian is that of the reweighted squares
    scatter: Float[Tensor, "p p"]  # of the single gradients
    spread: float  # residuals in standard deviations, robustly: 1 where the noise is right


def _linearized(data: ObservedPoints, T: SE3, log_factor: Tensor, noise: float, free_focal: bool) -> _System:
    """Linearize the residuals, in standard deviations, about ``T`` and the focal factor."""
    local = data.in_camera(T)
    front = local[:, 2] > 1e-9
    z = torch.where(front, local[:, 2], 1)
    focal = data.focal * log_factor.exp()
    # The observations are pixels, hence their image coordinates are multiplied by the given focal length, not the new one.
    off = local[:, :2] / z[:, None] * focal[:, None] - data.image * data.focal[:, None]
    deviation = _deviation(data, T, focal / z, noise)
    residual = torch.where(front[:, None], off / deviation[:, None], 30.0)
    squared = residual.square().sum(-1)
    weight = front / (1 + squared / SCALE**2)
    jacobian = _jacobian(data, T, local, z, focal, free_focal) / deviation[:, None, None]
    weighted = jacobian * weight[:, None, None]
    single = (weighted.mT @ residual[..., None])[..., 0]
    cost = 0.5 * SCALE**2 * torch.log1p(squared / SCALE**2).sum()
    hessian = (weighted.mT @ jacobian).sum(0)
    # d(w r)/dr = w I - 2 w^2 r r^T / c^2 for w = 1 / (1 + r^2 / c^2).
    curvature = hessian - 2 / SCALE**2 * (single.mT @ single)
    return _System(
        float(cost),
        single.sum(0),
        hessian,
        curvature,
        single.mT @ single,
        _spread(residual, hessian.shape[0]),
    )


def _deviation(data: ObservedPoints, T: SE3, pixels_per_metre: Tensor, noise: float) -> Float[Tensor, "m"]:
    """Return the standard deviation (pixels) of each residual along an axis, from the keypoint's and the point's noise."""
    return (noise**2 + _landmark_variance(data, T) * pixels_per_metre**2).sqrt()


def _landmark_variance(data: ObservedPoints, T: SE3) -> Tensor:
    """Return the variance (square metres) of the points perpendicular to the line of sight, averaged over both axes.

    Along the axis perpendicular to both the line of sight and ``directions``, this is the point's variance across. Along the
    other axis it is a mixture of the variances across and along, by the squared cosine and sine of the angle between the
    line of sight and ``directions``.
    """
    sight = data.points - T.apply(_centres(data))
    cosine = (sight * data.directions).sum(-1) / torch.linalg.vector_norm(sight, dim=-1).clamp(min=1e-12)
    across, along = data.deviations.square().unbind(-1)
    seen = cosine.square().clamp(max=1)
    return (across * (1 + seen) + along * (1 - seen)) / 2


def _centres(data: ObservedPoints) -> Tensor:
    """Return the centres of the cameras in the frame of the rig, metres."""
    return -(data.rotation.mT @ data.translation[..., None])[..., 0]


def _jacobian(
    data: ObservedPoints, T: SE3, local: Tensor, z: Tensor, focal: Tensor, free_focal: bool
) -> Tensor:
    """Return the derivative of the projection (pixels) by a right update of ``T`` and by the log of the focal length."""
    x, y, zero, inverse = local[:, 0] / z, local[:, 1] / z, torch.zeros_like(z), focal / z
    rows = torch.stack([inverse, zero, -x * inverse, zero, inverse, -y * inverse], dim=-1).unflatten(
        -1, (2, 3)
    )
    rig = T.inverse().apply(data.points)
    # A point of the rig's frame moves by -rho + [p]x phi under T exp(rho, phi).
    moved = torch.cat([-torch.eye(3, dtype=z.dtype).expand(len(z), 3, 3), skew(rig)], dim=-1)
    jacobian = rows @ data.rotation @ moved
    if free_focal:
        jacobian = torch.cat([jacobian, (local[:, :2] / z[:, None] * focal[:, None])[..., None]], dim=-1)
    return jacobian


def _spread(residual: Float[Tensor, "m 2"], unknowns: int) -> float:
    """Return a robust standard deviation along an axis, corrected for the number of unknowns that were fitted."""
    spare = max(1.0, 2 * len(residual) - unknowns) / (2 * len(residual))
    return 1.4826 * float(residual.abs().median()) / spare**0.5


def _solved(hessian: Tensor, damping: float, gradient: Tensor) -> Tensor:
    diagonal = hessian.diagonal().clamp(min=1e-12)
    return torch.linalg.solve(hessian + torch.diag(damping * diagonal), gradient)


def _sandwich(system: _System) -> Float[Tensor, "p p"]:
    """Return the covariance of an M-estimator, ``A^-1 S A^-1`` with curvature A and scatter S (Huber 1981, section 6.3)."""
    # With few residuals or many outliers the curvature may be indefinite; well-behaved residuals keep it near the Hessian.
    values, vectors = torch.linalg.eigh(system.curvature)
    least = 0.2 * torch.linalg.eigvalsh(system.hessian)
    inverse = vectors @ torch.diag(1 / values.maximum(least).clamp(min=1e-12)) @ vectors.mT
    return inverse @ system.scatter @ inverse
