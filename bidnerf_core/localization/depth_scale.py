"""The scale and offset errors that all depths of an image share: priors on them, and measured points under them."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.depth import DepthSensorModel
from bidnerf_core.geometry import SE3
from bidnerf_core.localization.costs.surface import SurfaceCost
from bidnerf_core.localization.landmarks.pose import LandmarkPose
from bidnerf_core.localization.normal_equations import NormalEquations
from bidnerf_core.localization.problem import Problem
from bidnerf_core.localization.solvers.pivots import Pivot

LANDMARK_SCALE_NOISE = 0.01
"""Relative standard deviation of the depth scale from a few landmarks, at the right pose."""
PRIOR_WIDTH = 2.0
"""Ratio of the standard deviation of the depth scale's prior to the sensor model's, since some sensors are off by far more."""
UNKNOWNS = 8
"""Number of unknowns: six for the pose, the factor and the offset."""
PLAUSIBLE = 5.0
"""Deviation of the landmarks' depth scale, in standard deviations, beyond which the depth has another unit or is wrong."""
LEAST_SCALE_DEVIATION = 1e-4
"""Minimum standard deviation of the factor, and of the offset relative to the distance, so that exact depth can be fused."""


@dataclass(frozen=True)
class DepthScale:
    """Constraints from the sensor's tolerance and the landmarks on the scale and offset of measured depth."""

    deviation: float  # standard deviation of the factor about 1, from the sensor's tolerance
    # Factor at the pose where landmarks were matched; None if too little depth was measured.
    by_landmarks: float | None = None
    offset: float = 0.0  # metres: standard deviation of the offset

    @staticmethod
    def of(found: LandmarkPose, sensor: DepthSensorModel) -> DepthScale:
        """Return the constraints on the scale of a sensor's depths, given a pose by landmarks."""
        return DepthScale(PRIOR_WIDTH * sensor.scale, found.depth_scale, PRIOR_WIDTH * sensor.offset)

    @property
    def objection(self) -> str | None:
        """Contradiction between sensor and landmarks, because of which depth should not be used; None if there is none."""
        deviation = math.hypot(self.deviation, LANDMARK_SCALE_NOISE)
        if self.by_landmarks is None or abs(self.by_landmarks - 1) <= PLAUSIBLE * deviation:
            return None
        return f"it is {1 / self.by_landmarks:.3g} times that of the landmarks"

    @property
    def estimate(self) -> float:
        """The factor from landmarks, shrunk towards 1 by the sensor's prior; 1 if they give none."""
        if self.by_landmarks is None:
            return 1.0
        weight = self.deviation**2 / (self.deviation**2 + LANDMARK_SCALE_NOISE**2)
        return 1 + weight * (self.by_landmarks - 1)


def at_pose(problem: Problem, found: LandmarkPose) -> Problem:
    """Return the problem with a pose as its start, the pose's intrinsics and motion, and depth corrected to the map's scale."""
    scale, views = DepthScale.of(found, problem.sensor).estimate, []
    for view in problem.views:
        depth = None if view.frame.depth is None else view.frame.depth * scale
        camera = found.intrinsics_of(view.frame.intrinsics) or view.frame.intrinsics
        frame = view.frame.replace(depth=depth, intrinsics=camera)
        views.append(replace(view, frame=frame, motion=found.motion))
    return replace(problem, start=found.T_world_camera, views=tuple(views))


@dataclass(frozen=True, eq=False)
class PoseAndDepth:
    """A pose, with the factor and the offset (metres) that correct the distances of measured points."""

    T: SE3
    factor: float = 1.0
    offset: float = 0.0

    def moved(self, about: Pivot, update: Float[Tensor, "8"]) -> PoseAndDepth:
        """Return the state after an update of the pose (about a pivot), the factor and the offset."""
        T = about.moved(self.T[None], update[None, :6])[0].normalized()
        return PoseAndDepth(T, self.factor + float(update[6]), self.offset + float(update[7]))


@dataclass(frozen=True, eq=False)
class ScaledPoints:
    """Measured points on the surface, whose depths share an unknown factor and offset.

    The factor is relative to ``scale.estimate``, by which the points of ``cost`` were corrected at the pose ``start``. The
    equations have eight unknowns: an update of the pose about the middle of those points, the factor and the offset.
    """

    cost: SurfaceCost
    scale: DepthScale
    start: SE3

    def at(self, here: PoseAndDepth) -> SurfaceCost:
        """Return the cost of the points with their depths corrected, with their own middle as the pivot."""
        return replace(self.cost, cloud=self.cost.cloud.corrected(here.factor, here.offset))

    def about_middle(self, cost: SurfaceCost, equations: NormalEquations) -> NormalEquations:
        """Convert equations about the middle of the points of ``cost`` to the middle of those of ``self.cost``."""
        updates = torch.eye(UNKNOWNS, dtype=torch.float64)
        updates[:6, :6] = cost.cloud.pivot.adjoint_from(self.cost.cloud.pivot)
        return equations.of_others(updates)

    def assumed(self, at: PoseAndDepth) -> NormalEquations:
        """Return the equations of the priors on the factor and the offset, from the sensor's tolerance and the landmarks.

        Landmarks give the ratio of their depths to the measured ones. It changes with the pose in proportion to the distances
        of the measured points.
        """
        applied, distance = self.scale.estimate, self._distance
        by_factor, by_offset = applied * _unit(6), _unit(7)
        least = LEAST_SCALE_DEVIATION
        whole = residual_equations(applied * at.factor - 1, by_factor, max(self.scale.deviation, least))
        whole += residual_equations(at.offset, by_offset, max(self.scale.offset, least * distance))
        if self.scale.by_landmarks is None:
            return whole
        ratio, by_pose = self._relative_distance(at.T)
        residual = applied * (at.factor + at.offset / distance) - self.scale.by_landmarks * ratio
        jacobian = by_factor + applied / distance * by_offset
        jacobian[:6] = -self.scale.by_landmarks * by_pose
        return whole + residual_equations(residual, jacobian, LANDMARK_SCALE_NOISE)

    @property
    def _distance(self) -> float:
        """Median distance of the points, metres."""
        cloud = self.cost.cloud
        return float(torch.linalg.vector_norm(cloud.points - cloud.origins, dim=-1).median())

    def _relative_distance(self, T: SE3) -> tuple[float, Float[Tensor, "6"]]:
        """Return the mean ratio of the points' distances from a pose to those from ``start``, and its derivative.

        The points are fixed in the world, where ``start`` places them.
        """
        cloud = self.cost.cloud.to("cpu")
        points, origins = cloud.points.double(), cloud.origins.double()
        lines = points - origins
        lengths = torch.linalg.vector_norm(lines, dim=-1).clamp(min=1e-12)
        per_length = lines / lengths[:, None] ** 2
        seen = (T.inverse() @ self.start).apply(points)
        ratio = float((per_length * (seen - origins)).sum(-1).mean())
        turned = torch.linalg.cross(seen - cloud.middle.double(), per_length)
        return ratio, -torch.cat([per_length, turned], -1).mean(0)


def residual_equations(residual: float, jacobian: Float[Tensor, "k"], deviation: float) -> NormalEquations:
    """Return the normal equations of a single residual with standard deviation ``deviation``."""
    whitened, value = jacobian / deviation, residual / deviation
    return NormalEquations(
        whitened.new_tensor([value**2]), value * whitened[None], torch.outer(whitened, whitened)[None]
    )


def of_pose(equations: NormalEquations) -> NormalEquations:
    """Extend the equations of a pose by the factor and the offset, on which they do not depend."""
    return equations.of_others(torch.eye(6, UNKNOWNS, dtype=torch.float64))


def _unit(place: int) -> Float[Tensor, "8"]:
    return torch.eye(UNKNOWNS, dtype=torch.float64)[place]
