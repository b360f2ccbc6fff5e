"""Bundle adjustment: jointly estimate the poses of images and the points that they observe (Triggs et al. 2000).

The given poses are a prior, which also fixes the gauge: position, orientation and scale. The motion of each camera during its
rolling shutter's readout may be estimated too (Hedborg et al., Rolling shutter bundle adjustment, CVPR 2012). The solver is
robust Levenberg-Marquardt, with the points eliminated by the Schur complement.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.sparse import block_diag, bsr_array, csc_array
from scipy.sparse.linalg import splu
from torch import Tensor

from bidnerf_core.camera import STILL, MotionPrior, poses_of_rows
from bidnerf_core.geometry import SE3, cauchy_loss, inlier_weight
from bidnerf_core.mapping.geometry.triangulation import Sightings, damp, sum_by
from bidnerf_core.mapping.resection.states import by_camera_point, by_update, pinhole
from bidnerf_core.progress import check_cancelled

SMALL_DECREASE = 1e-4
"""Relative decrease of the cost below which the iteration has converged."""
RESIDUAL_SCALE, PRIOR_SCALE = 2.0, 5.0
"""Scales of the Cauchy losses of an observation and of a pose (six components), in standard deviations. The prior hardly
constrains a pose that is plainly wrong.
"""


@dataclass(frozen=True, eq=False)
class PosePrior:
    """The prior of the poses: their given values, with errors that are independent and isotropic."""

    T_world_camera: SE3  # (v), float64
    translation: float  # metres: standard deviation along each axis
    rotation: float  # radians: standard deviation about each axis
    motion: MotionPrior = STILL  # how far the cameras may have moved during the readout of an image


@dataclass(frozen=True, eq=False)
class Adjustment:
    """Poses, points and camera motions that fit the observations best."""

    T_world_camera: SE3  # (v), of the middle rows
    points: Float[Tensor, "n 3"]  # metres, world
    motion: Float[Tensor, "v 6"]  # from the first row to the last: metres, then radians
    cost: float = 0.0


def adjust_bundle(
    sightings: Sightings,
    start: Adjustment,
    prior: PosePrior,
    noise: float,
    correlation: float = 1.0,
    tolerance: float = SMALL_DECREASE,
) -> Adjustment:
    """Minimize the robust reprojection error plus the prior from ``start``; the poses in ``sightings`` are ignored.

    ``noise`` is the standard deviation of an observation along each axis (pixels), and ``correlation`` the number of
    observations that count as one because their errors are correlated. Images without observations keep their given poses.
    The iteration ends at a relative decrease of the cost below ``tolerance``. Motions stay fixed unless ``prior`` frees them.
    """
    state, damping = start, 1e-4
    system = linearize(sightings, state, prior, noise, correlation)
    for _ in range(30):  # about ten suffice from poses that are off by a few pixels
        check_cancelled("bundle adjustment")
        of_images, of_points = system.step(damping)
        motion = state.motion + of_images[:, 6:] if of_images.shape[1] > 6 else state.motion
        moved = Adjustment(state.T_world_camera.retract(of_images[:, :6]), state.points + of_points, motion)
        tried = linearize(sightings, moved, prior, noise, correlation)
        if not tried.cost <= system.cost:
            damping *= 10
            if damping > 1e6:  # relative to the diagonal; no smaller step is tried
                break
            continue
        gained = system.cost - tried.cost
        state, system, damping = moved, tried, max(damping / 10, 1e-9)
        if gained <= tolerance * system.cost:
            break
    return replace(state, T_world_camera=state.T_world_camera.normalized(), cost=system.cost)


@dataclass(frozen=True, eq=False)
class AdjustmentSystem:
    """Normal equations for the poses of images and for points, stored as blocks.

    An image has six unknowns, the right update of its pose (translation first), or twelve if its motion is estimated too.
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
        """Solve the damp normal equations for the updates of image poses and points, by the Schur complement."""
        inverse = torch.linalg.inv(damp(self.point_blocks, damping, 1e-9))
        eliminated = self.mixed_blocks @ inverse[self.point]
        mixed, product = self._sparse(self.mixed_blocks), self._sparse(eliminated)
        reduced = block_diag(damp(self.image_blocks, damping, 1e-9).numpy(), format="csc")
        reduced = csc_array(reduced - (product @ mixed.T).tocsc())
        right = product @ self.point_gradient.numpy().ravel() - self.image_gradient.numpy().ravel()
        factors = splu(reduced, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
        of_images = factors.solve(right)
        rest = self.point_gradient + torch.from_numpy(mixed.T @ of_images).reshape(-1, 3)
        of_points = -(inverse @ rest[..., None])[..., 0]
        return torch.from_numpy(of_images).reshape_as(self.image_gradient), of_points

    def _sparse(self, blocks: Float[Tensor, "m k 3"]) -> bsr_array:
        """Assemble the observations' blocks into a sparse matrix (k v, 3 n)."""
        order = torch.argsort(self.image, stable=True)
        rows, columns = len(self.image_gradient), len(self.point_gradient)
        ends = np.concatenate([[0], torch.bincount(self.image, minlength=rows).cumsum(0).numpy()])
        parts = (blocks[order].numpy(), self.point[order].numpy(), ends)
        return bsr_array(parts, shape=(blocks.shape[1] * rows, 3 * columns))


def linearize(
    sightings: Sightings, state: Adjustment, prior: PosePrior, noise: float, correlation: float = 1.0
) -> AdjustmentSystem:
    """Linearize the cost at a state: return its normal equations, weighted as in iteratively reweighted least squares."""
    view, point, times = sightings.view, sightings.point, sightings.exposure_times
    T = state.T_world_camera[view]
    if bool(state.motion.any()):
        T = T @ poses_of_rows(times, state.motion[view])
    rotation = T.rotation.mT
    local = (rotation @ (state.points[point] - T.translation)[..., None])[..., 0]
    flat, depth, front = pinhole(local)
    scale = torch.where(front, sightings.focal / noise, 0)[:, None]
    residual = (flat - sightings.image) * scale
    squared = residual.square().sum(-1)
    weight = inlier_weight(squared, RESIDUAL_SCALE) / correlation
    cost = cauchy_loss(squared.numpy(), RESIDUAL_SCALE) / correlation
    by_local = by_camera_point(flat, depth) * scale[..., None]
    by_view, by_point = by_update(by_local, local), by_local @ rotation
    if prior.motion != STILL:
        # To first order in the motion, an update of the middle row's pose updates the pose of any other row alike.
        by_view = torch.cat([by_view, times[:, None, None] * by_view], dim=-1)
    views, count = len(state.motion), len(state.points)
    view_weighted, point_weighted = (by.mT * weight[:, None, None] for by in (by_view, by_point))
    prior_cost, pull, precision = _prior_term(state, prior)
    column = residual[..., None]
    return AdjustmentSystem(
        cost + prior_cost,
        sum_by((view_weighted @ column)[..., 0], view, views) + pull,
        sum_by((point_weighted @ column)[..., 0], point, count),
        sum_by(view_weighted @ by_view, view, views) + torch.diag_embed(precision),
        sum_by(point_weighted @ by_point, point, count),
        view_weighted @ by_point,
        view,
        point,
    )


def _prior_term(state: Adjustment, prior: PosePrior) -> tuple[float, Float[Tensor, "v k"], Float[Tensor, "v k"]]:
    """Return the cost, the gradient and the diagonal of the precision of the prior.

    Deviations from the given poses have a Cauchy loss, and motions a quadratic one.
    """
    given, T = prior.T_world_camera, state.T_world_camera
    away = (T.rotation.mT @ (T.translation - given.translation)[..., None])[..., 0]  # in the camera's frame
    turned = SE3(given.rotation.mT @ T.rotation, torch.zeros_like(away)).log()[:, 3:]
    difference = torch.cat([away, turned], dim=-1)
    deviations = torch.tensor([prior.translation] * 3 + [prior.rotation] * 3, dtype=difference.dtype)
    squared = (difference / deviations).square().sum(-1)
    precision = deviations**-2 * inlier_weight(squared, PRIOR_SCALE)[:, None]
    cost = cauchy_loss(squared.numpy(), PRIOR_SCALE)
    if prior.motion != STILL:
        of_motion = (prior.motion.deviations**-2).expand_as(state.motion)
        cost += 0.5 * float((of_motion * state.motion.square()).sum())
        difference, precision = torch.cat([difference, state.motion], dim=-1), torch.cat([precision, of_motion], dim=-1)
    return cost, precision * difference, precision
