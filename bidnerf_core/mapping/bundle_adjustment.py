"""Bundle adjustment: estimate the poses of images and the points that they show together (Triggs et al. 2000).

The given poses are a prior, which also fixes what the images leave free: the position, orientation and, without depth, scale
of everything. Robust Levenberg-Marquardt; the points are eliminated by the Schur complement.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.sparse import block_diag, bsr_array, csc_array
from scipy.sparse.linalg import splu
from torch import Tensor

from bidnerf_core.mapping.triangulation import Sightings
from bidnerf_core.se3 import SE3

ADJUSTMENT_STEPS = 30
"""Largest number of steps; from poses that are off by a few pixels, about ten suffice."""
SETTLED = 1e-4
"""Relative decrease of the cost below which the iteration has converged."""
LARGEST_DAMPING = 1e6
"""Damping (relative to the diagonal) beyond which no smaller step is tried."""
RESIDUAL_SCALE, PRIOR_SCALE = 2.0, 5.0
"""Scales of the Cauchy losses in standard deviations: that of a sighting or depth, and that of a pose, which has six
components. A pose that is plainly wrong is hardly held by its prior.
"""
ALMOST_SINGULAR = 1e-9
"""Damping, relative to the mean diagonal, which makes the blocks of points without parallax invertible."""


@dataclass(frozen=True, eq=False)
class PosePrior:
    """The given poses and how far off they are: independent of each other, along all axes alike."""

    T_world_camera: SE3  # (v), float64
    translation: float  # metres: standard deviation along each axis
    rotation: float  # radians: standard deviation about each axis


@dataclass(frozen=True, eq=False)
class MeasuredSightings:
    """Sightings of points by numbered images, the depth measured at each, and how accurate both are."""

    sightings: Sightings  # their poses serve as a start
    image: Int[Tensor, "m"]
    depth: Float[Tensor, "m"]  # metres, planar z; 0 where none was measured
    noise: float  # pixels: standard deviation of a sighting along each axis
    relative_depth_noise: float
    correlation: float = 1.0  # the number of sightings that count as one, because their errors are correlated


@dataclass(frozen=True, eq=False)
class Adjustment:
    """Poses and points that fit the sightings best."""

    T_world_camera: SE3  # (v)
    points: Float[Tensor, "n 3"]  # metres, world
    cost: float


def adjusted(
    seen: MeasuredSightings,
    points: Float[Tensor, "n 3"],
    prior: PosePrior,
    start: SE3 | None = None,
    settled: float = SETTLED,
) -> Adjustment:
    """Minimize the robust reprojection and depth errors and the prior, from ``points`` and ``start`` or the given poses.

    Images without sightings keep their given poses. ``settled`` is the relative decrease of the cost that ends the
    iteration.
    """
    state, damping = Adjustment(start or prior.T_world_camera, points, 0.0), 1e-4
    system = linearized(seen, state, prior)
    for _ in range(ADJUSTMENT_STEPS):
        moved = _retracted(state, *system.step(damping))
        tried = linearized(seen, moved, prior)
        if not tried.cost <= system.cost:
            damping *= 10
            if damping > LARGEST_DAMPING:
                break
            continue
        gained = system.cost - tried.cost
        state, system, damping = moved, tried, max(damping / 10, 1e-9)
        if gained <= settled * system.cost:
            break
    return Adjustment(state.T_world_camera.normalized(), state.points, system.cost)


def _retracted(
    state: Adjustment, of_poses: Float[Tensor, "v 6"], of_points: Float[Tensor, "n 3"]
) -> Adjustment:
    return Adjustment(state.T_world_camera.retract(of_poses), state.points + of_points, 0.0)


@dataclass(frozen=True, eq=False)
class AdjustmentSystem:
    """Normal equations of poses (right updates, translation first) and points, in blocks."""

    cost: float
    pose_gradient: Float[Tensor, "v 6"]
    point_gradient: Float[Tensor, "n 3"]
    pose_blocks: Float[Tensor, "v 6 6"]
    point_blocks: Float[Tensor, "n 3 3"]
    mixed_blocks: Float[Tensor, "m 6 3"]  # one per sighting
    image: Int[Tensor, "m"]
    point: Int[Tensor, "m"]

    def step(self, damping: float) -> tuple[Float[Tensor, "v 6"], Float[Tensor, "n 3"]]:
        """Return the updates of poses and points that solve the damped equations."""
        inverse = torch.linalg.inv(_damped(self.point_blocks, damping))
        eliminated = self.mixed_blocks @ inverse[self.point]
        mixed, product = self._sparse(self.mixed_blocks), self._sparse(eliminated)
        reduced = block_diag(_damped(self.pose_blocks, damping).numpy(), format="csc")
        reduced = csc_array(reduced - (product @ mixed.T).tocsc())
        right = product @ self.point_gradient.numpy().ravel() - self.pose_gradient.numpy().ravel()
        factors = splu(
            reduced, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
        )
        of_poses = factors.solve(right)
        rest = self.point_gradient + torch.from_numpy(mixed.T @ of_poses).reshape(-1, 3)
        of_points = -(inverse @ rest[..., None])[..., 0]
        return torch.from_numpy(of_poses).reshape(-1, 6), of_points

    def _sparse(self, blocks: Float[Tensor, "m 6 3"]) -> bsr_array:
        """Return the matrix (6 v, 3 n) of the sightings' blocks."""
        order = torch.argsort(self.image, stable=True)
        rows, columns = len(self.pose_gradient), len(self.point_gradient)
        ends = np.concatenate([[0], torch.bincount(self.image, minlength=rows).cumsum(0).numpy()])
        parts = (blocks[order].numpy(), self.point[order].numpy(), ends)
        return bsr_array(parts, shape=(6 * rows, 3 * columns))


def linearized(seen: MeasuredSightings, state: Adjustment, prior: PosePrior) -> AdjustmentSystem:
    """Return the normal equations about a state, with weights of iteratively reweighted least squares."""
    T, points = state.T_world_camera, state.points
    image, point, views, count = seen.image, seen.sightings.point, len(T.translation), len(points)
    rotation = T.rotation[image].mT
    local = (rotation @ (points[point] - T.translation[image])[..., None])[..., 0]
    residual, by_local = _measured(seen, local)
    squared = torch.stack([residual[:, :2].square().sum(-1), residual[:, 2].square()], dim=-1)
    weight = (1 / (1 + squared / RESIDUAL_SCALE**2))[:, [0, 0, 1]] / seen.correlation
    cost = 0.5 * RESIDUAL_SCALE**2 * float(torch.log1p(squared / RESIDUAL_SCALE**2).sum()) / seen.correlation
    # A point of the camera's frame moves by -rho + p x phi under T exp(rho, phi), and r (p x phi) = (r x p) phi.
    turned = torch.linalg.cross(by_local, local[:, None].expand_as(by_local))
    by_pose, by_point = torch.cat([-by_local, turned], dim=-1), by_local @ rotation
    pose_weighted, point_weighted = by_pose.mT * weight[:, None], by_point.mT * weight[:, None]
    held = _held(T, prior)
    column = residual[..., None]
    return AdjustmentSystem(
        cost + held.cost,
        _summed((pose_weighted @ column)[..., 0], image, views) + held.gradient,
        _summed((point_weighted @ column)[..., 0], point, count),
        _summed(pose_weighted @ by_pose, image, views) + torch.diag_embed(held.precision),
        _summed(point_weighted @ by_point, point, count),
        pose_weighted @ by_point, image, point,
    )  # fmt: skip


def _measured(
    seen: MeasuredSightings, local: Float[Tensor, "m 3"]
) -> tuple[Float[Tensor, "m 3"], Float[Tensor, "m 3 3"]]:
    """Return the residuals (u, v, depth) in standard deviations, and their Jacobian with respect to points in the camera.

    Points behind the camera and depth that was not measured have zeros.
    """
    front = local[:, 2] > 0
    z = torch.where(front, local[:, 2], 1)
    flat = local[:, :2] / z[:, None]
    scale = torch.where(front, seen.sightings.focal / seen.noise, 0)
    inverse, zero = scale / z, torch.zeros_like(z)
    known = seen.depth > 0
    deeper = torch.where(known, 1 / (torch.where(known, seen.depth, 1) * seen.relative_depth_noise), 0)
    off = torch.cat(
        [(flat - seen.sightings.image) * scale[:, None], ((local[:, 2] - seen.depth) * deeper)[:, None]], 1
    )
    rows = [inverse, zero, -flat[:, 0] * inverse, zero, inverse, -flat[:, 1] * inverse, zero, zero, deeper]
    return off, torch.stack(rows, dim=-1).unflatten(-1, (3, 3))


@dataclass(frozen=True, eq=False)
class _Held:
    cost: float
    gradient: Float[Tensor, "v 6"]
    precision: Float[Tensor, "v 6"]


def _held(T: SE3, prior: PosePrior) -> _Held:
    """Return the prior's part: the distances from the given poses in standard deviations, under a Cauchy loss."""
    given = prior.T_world_camera
    away = (T.rotation.mT @ (T.translation - given.translation)[..., None])[..., 0]  # camera
    turned = SE3(given.rotation.mT @ T.rotation, torch.zeros_like(away)).log()[:, 3:]
    off = torch.cat([away, turned], dim=-1)
    deviations = torch.tensor([prior.translation] * 3 + [prior.rotation] * 3, dtype=off.dtype)
    squared = (off / deviations).square().sum(-1)
    precision = deviations**-2 / (1 + squared / PRIOR_SCALE**2)[:, None]
    cost = 0.5 * PRIOR_SCALE**2 * float(torch.log1p(squared / PRIOR_SCALE**2).sum())
    return _Held(cost, precision * off, precision)


def _damped(blocks: Float[Tensor, "b k k"], damping: float) -> Float[Tensor, "b k k"]:
    diagonal = blocks.diagonal(dim1=-2, dim2=-1)
    least = ALMOST_SINGULAR * diagonal.mean(-1, keepdim=True).clamp(min=1e-30)
    return blocks + torch.diag_embed(damping * diagonal + least)


def _summed(values: Tensor, index: Tensor, count: int) -> Tensor:
    return torch.zeros((count, *values.shape[1:]), dtype=values.dtype).index_add_(0, index, values)
