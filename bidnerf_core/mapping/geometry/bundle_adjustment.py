"""Bundle adjustment: estimate the poses of images and the points that they show together (Triggs et al. 2000).

The given poses are a prior, which also fixes what the images leave free: the position, orientation and, without depth, scale
of everything. The motions of the cameras while the rows of their images are exposed may be estimated too (Hedborg et al.,
Rolling shutter bundle adjustment, CVPR 2012). Robust Levenberg-Marquardt; the points are eliminated by the Schur complement.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.sparse import block_diag, bsr_array, csc_array
from scipy.sparse.linalg import splu
from torch import Tensor

from bidnerf_core.camera.rolling_shutter import STILL, MotionPrior, poses_of_rows
from bidnerf_core.geometry.se3 import SE3
from bidnerf_core.mapping.geometry.triangulation import Sightings

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
    motion: MotionPrior = STILL  # how far the cameras may have moved while the rows of an image were exposed


@dataclass(frozen=True, eq=False)
class MeasuredSightings:
    """Sightings of points by numbered images, the depth measured at each, and how accurate both are."""

    sightings: Sightings  # their poses serve as a start
    image: Int[Tensor, "m"]
    depth: Float[Tensor, "m"]  # metres, planar z; 0 where none was measured
    noise: float  # pixels: standard deviation of a sighting along each axis
    relative_depth_noise: float
    correlation: float = 1.0  # the number of sightings that count as one, because their errors are correlated
    exposure_times: Float[Tensor, "m"] | None = None  # see ``rolling_shutter``; needed to estimate motions


@dataclass(frozen=True, eq=False)
class Adjustment:
    """Poses, points and motions that fit the sightings best."""

    T_world_camera: SE3  # (v), of the middle rows
    points: Float[Tensor, "n 3"]  # metres, world
    motion: Float[Tensor, "v 6"]  # from the first row to the last
    cost: float = 0.0


def adjusted(
    seen: MeasuredSightings,
    points: Float[Tensor, "n 3"],
    prior: PosePrior,
    start: SE3 | None = None,
    settled: float = SETTLED,
    motion: Float[Tensor, "v 6"] | None = None,
) -> Adjustment:
    """Minimize the robust reprojection and depth errors and the prior, from ``points`` and ``start`` or the given poses.

    Images without sightings keep their given poses. ``settled`` is the relative decrease of the cost that ends the
    iteration. ``motion`` is where the motions start, by default at rest; they stay there if ``prior`` leaves none free.
    """
    T = start or prior.T_world_camera
    motion = torch.zeros(len(T.translation), 6, dtype=torch.float64) if motion is None else motion
    state, damping = Adjustment(T, points, motion), 1e-4
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
    return replace(state, T_world_camera=state.T_world_camera.normalized(), cost=system.cost)


def _retracted(
    state: Adjustment, of_images: Float[Tensor, "v k"], of_points: Float[Tensor, "n 3"]
) -> Adjustment:
    motion = state.motion + of_images[:, 6:] if of_images.shape[1] > 6 else state.motion
    return Adjustment(state.T_world_camera.retract(of_images[:, :6]), state.points + of_points, motion)


@dataclass(frozen=True, eq=False)
class AdjustmentSystem:
    """Normal equations of images and points, in blocks.

    An image has six unknowns, the right update of its pose (translation first), or twelve, with its motion.
    """

    cost: float
    image_gradient: Float[Tensor, "v k"]
    point_gradient: Float[Tensor, "n 3"]
    image_blocks: Float[Tensor, "v k k"]
    point_blocks: Float[Tensor, "n 3 3"]
    mixed_blocks: Float[Tensor, "m k 3"]  # one per sighting
    image: Int[Tensor, "m"]
    point: Int[Tensor, "m"]

    def step(self, damping: float) -> tuple[Float[Tensor, "v k"], Float[Tensor, "n 3"]]:
        """Return the updates of images and points that solve the damped equations."""
        inverse = torch.linalg.inv(_damped(self.point_blocks, damping))
        eliminated = self.mixed_blocks @ inverse[self.point]
        mixed, product = self._sparse(self.mixed_blocks), self._sparse(eliminated)
        reduced = block_diag(_damped(self.image_blocks, damping).numpy(), format="csc")
        reduced = csc_array(reduced - (product @ mixed.T).tocsc())
        right = product @ self.point_gradient.numpy().ravel() - self.image_gradient.numpy().ravel()
        factors = splu(
            reduced, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
        )
        of_images = factors.solve(right)
        rest = self.point_gradient + torch.from_numpy(mixed.T @ of_images).reshape(-1, 3)
        of_points = -(inverse @ rest[..., None])[..., 0]
        return torch.from_numpy(of_images).reshape_as(self.image_gradient), of_points

    def _sparse(self, blocks: Float[Tensor, "m k 3"]) -> bsr_array:
        """Return the matrix (k v, 3 n) of the sightings' blocks."""
        order = torch.argsort(self.image, stable=True)
        rows, columns = len(self.image_gradient), len(self.point_gradient)
        ends = np.concatenate([[0], torch.bincount(self.image, minlength=rows).cumsum(0).numpy()])
        parts = (blocks[order].numpy(), self.point[order].numpy(), ends)
        return bsr_array(parts, shape=(blocks.shape[1] * rows, 3 * columns))


def linearized(seen: MeasuredSightings, state: Adjustment, prior: PosePrior) -> AdjustmentSystem:
    """Return the normal equations about a state, with weights of iteratively reweighted least squares."""
    image, point, points = seen.image, seen.sightings.point, state.points
    views, count = len(state.motion), len(points)
    T = _poses_at_exposure(seen, state)
    rotation = T.rotation.mT
    local = (rotation @ (points[point] - T.translation)[..., None])[..., 0]
    residual, by_local = _measured(seen, local)
    squared = torch.stack([residual[:, :2].square().sum(-1), residual[:, 2].square()], dim=-1)
    weight = (1 / (1 + squared / RESIDUAL_SCALE**2))[:, [0, 0, 1]] / seen.correlation
    cost = 0.5 * RESIDUAL_SCALE**2 * float(torch.log1p(squared / RESIDUAL_SCALE**2).sum()) / seen.correlation
    # A point of the camera's frame moves by -rho + p x phi under T exp(rho, phi), and r (p x phi) = (r x p) phi.
    turned = torch.linalg.cross(by_local, local[:, None].expand_as(by_local))
    by_image, by_point = torch.cat([-by_local, turned], dim=-1), by_local @ rotation
    if prior.motion != STILL:
        assert seen.exposure_times is not None
        # To first order in the motion, an update of the pose of the middle row is one of the pose at any other row.
        by_image = torch.cat([by_image, seen.exposure_times[:, None, None] * by_image], dim=-1)
    image_weighted, point_weighted = by_image.mT * weight[:, None], by_point.mT * weight[:, None]
    held = _held(state, prior)
    column = residual[..., None]
    return AdjustmentSystem(
        cost + held.cost,
        _summed((image_weighted @ column)[..., 0], image, views) + held.gradient,
        _summed((point_weighted @ column)[..., 0], point, count),
        _summed(image_weighted @ by_image, image, views) + torch.diag_embed(held.precision),
        _summed(point_weighted @ by_point, point, count),
        image_weighted @ by_point, image, point,
    )  # fmt: skip


def _poses_at_exposure(seen: MeasuredSightings, state: Adjustment) -> SE3:
    """Return the pose of the camera at each sighting, when its row was exposed."""
    T = state.T_world_camera[seen.image]
    if seen.exposure_times is None or not bool(state.motion.any()):
        return T
    return T @ poses_of_rows(seen.exposure_times, state.motion[seen.image])


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
    gradient: Float[Tensor, "v k"]
    precision: Float[Tensor, "v k"]


def _held(state: Adjustment, prior: PosePrior) -> _Held:
    """Return the prior's part: the distances from the given poses in standard deviations, under a Cauchy loss, and the
    motions under a quadratic one.
    """
    given, T = prior.T_world_camera, state.T_world_camera
    away = (T.rotation.mT @ (T.translation - given.translation)[..., None])[..., 0]  # camera
    turned = SE3(given.rotation.mT @ T.rotation, torch.zeros_like(away)).log()[:, 3:]
    off = torch.cat([away, turned], dim=-1)
    deviations = torch.tensor([prior.translation] * 3 + [prior.rotation] * 3, dtype=off.dtype)
    squared = (off / deviations).square().sum(-1)
    precision = deviations**-2 / (1 + squared / PRIOR_SCALE**2)[:, None]
    cost = 0.5 * PRIOR_SCALE**2 * float(torch.log1p(squared / PRIOR_SCALE**2).sum())
    if prior.motion != STILL:
        of_motion = (prior.motion.deviations**-2).expand_as(state.motion)
        cost += 0.5 * float((of_motion * state.motion.square()).sum())
        off, precision = torch.cat([off, state.motion], dim=-1), torch.cat([precision, of_motion], dim=-1)
    return _Held(cost, precision * off, precision)


def _damped(blocks: Float[Tensor, "b k k"], damping: float) -> Float[Tensor, "b k k"]:
    diagonal = blocks.diagonal(dim1=-2, dim2=-1)
    least = ALMOST_SINGULAR * diagonal.mean(-1, keepdim=True).clamp(min=1e-30)
    return blocks + torch.diag_embed(damping * diagonal + least)


def _summed(values: Tensor, index: Tensor, count: int) -> Tensor:
    return torch.zeros((count, *values.shape[1:]), dtype=values.dtype).index_add_(0, index, values)
