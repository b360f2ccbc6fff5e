"""What is known of the factor that corrects all depths of an image, and measured points that share it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.depth_sensor import DepthSensorModel
from bidnerf_core.localization.costs.surface import SurfaceCost
from bidnerf_core.localization.normal_equations import NormalEquations
from bidnerf_core.localization.search.landmark_pose import LandmarkPose
from bidnerf_core.se3 import SE3

LANDMARK_SCALE_NOISE = 0.01
"""Relative standard deviation of the depth scale that a few landmarks give, from the right pose."""
PRIOR_WIDTH = 2.0
"""Standard deviation of the prior of the depth scale over that of the sensor's scale, since single sensors are off by far more."""
PLAUSIBLE = 5.0
"""Standard deviations of the depth scale by landmarks beyond which the depth is of another unit, or otherwise wrong."""
LEAST_SCALE_DEVIATION = 1e-4
"""Least standard deviation of the factor, so that a sensor without errors can be fused."""


@dataclass(frozen=True)
class DepthScale:
    """What a sensor's tolerance and landmarks say of the factor that corrects measured depth."""

    deviation: float  # of the factor about 1, by the sensor
    # Factor from the pose at which landmarks were matched; None if too little was measured.
    by_landmarks: float | None = None

    @staticmethod
    def of(found: LandmarkPose, sensor: DepthSensorModel) -> DepthScale:
        """Return what is known of the depths that a sensor measured with a pose by landmarks."""
        return DepthScale(PRIOR_WIDTH * sensor.scale, found.depth_scale)

    @property
    def objection(self) -> str | None:
        """Why sensor and landmarks cannot both be right, so that the depth should be left out; None if they can."""
        deviation = math.hypot(self.deviation, LANDMARK_SCALE_NOISE)
        if self.by_landmarks is None or abs(self.by_landmarks - 1) <= PLAUSIBLE * deviation:
            return None
        return f"it is {1 / self.by_landmarks:.3g} times as long as by landmarks"

    @property
    def estimate(self) -> float:
        """The factor that landmarks give, shrunk towards 1 by the sensor's prior; 1 if they give none."""
        if self.by_landmarks is None:
            return 1.0
        weight = self.deviation**2 / (self.deviation**2 + LANDMARK_SCALE_NOISE**2)
        return 1 + weight * (self.by_landmarks - 1)


@dataclass(frozen=True, eq=False)
class PoseAndFactor:
    """A pose, and the factor by which measured depths are corrected."""

    T: SE3
    factor: float = 1.0


@dataclass(frozen=True, eq=False)
class ScaledPoints:
    """Measured points on the surface, whose depths share an unknown factor.

    The factor is relative to ``scale.estimate``, by which the points of ``cost`` were corrected from the pose ``start``.
    Equations are of seven unknowns: an update of the pose about the middle of those points, and the factor.
    """

    cost: SurfaceCost
    scale: DepthScale
    start: SE3

    def at(self, factor: float) -> SurfaceCost:
        """Return the cost of the points with their depths multiplied by a factor, about their own middle."""
        return replace(self.cost, cloud=self.cost.cloud.scaled(factor))

    def cost_at(self, at: PoseAndFactor) -> Float[Tensor, "1"]:
        """Return the value of that cost at a pose."""
        return self.at(at.factor).cost(at.T[None])

    def about_middle(self, cost: SurfaceCost, equations: NormalEquations) -> NormalEquations:
        """Return the equations of points of some factor about the middle of those of ``self.cost``."""
        updates = torch.eye(7, dtype=torch.float64)
        updates[:6, :6] = cost.cloud.pivot.adjoint_from(self.cost.cloud.pivot)
        return equations.of_others(updates)

    def assumed(self, at: PoseAndFactor) -> NormalEquations:
        """Return the cost of what the sensor's tolerance and the landmarks say of the factor.

        Landmarks give the ratio of their depths to the measured ones, which changes with the pose as the distances of what
        lay at the measured points do.
        """
        applied = self.scale.estimate
        by_factor = torch.zeros(7, dtype=torch.float64)
        by_factor[6] = applied
        deviation = max(self.scale.deviation, LEAST_SCALE_DEVIATION)
        whole = residual_equations(applied * at.factor - 1, by_factor, deviation)
        if self.scale.by_landmarks is None:
            return whole
        ratio, by_pose = self._relative_distance(at.T)
        residual = applied * at.factor - self.scale.by_landmarks * ratio
        jacobian = by_factor
        jacobian[:6] = -self.scale.by_landmarks * by_pose
        return whole + residual_equations(residual, jacobian, LANDMARK_SCALE_NOISE)

    def _relative_distance(self, T: SE3) -> tuple[float, Float[Tensor, "6"]]:
        """Return how far what lay at the points from the start is from a pose, relative to the start, and its derivative."""
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
    """Return the cost of a single residual with that standard deviation."""
    whitened, value = jacobian / deviation, residual / deviation
    return NormalEquations(
        whitened.new_tensor([value**2]), value * whitened[None], torch.outer(whitened, whitened)[None]
    )


def with_factor(equations: NormalEquations) -> NormalEquations:
    """Return the equations of a pose as those of pose and factor, on which they do not depend."""
    return equations.of_others(torch.eye(6, 7, dtype=torch.float64))
