"""What is known of the factor that corrects all depths of an image, and measured points that share it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.depth_sensor import DepthSensorModel
from bidnerf_core.localization.costs.surface import SurfaceCost
from bidnerf_core.localization.normal_equations import NormalEquations
from bidnerf_core.localization.search.landmark_pose import LandmarkPose
from bidnerf_core.se3 import SE3, skew

LANDMARK_SCALE_NOISE = 0.01
"""Relative standard deviation of the depth scale that a few landmarks give, from the right pose."""
PRIOR_WIDTH = 2.0
"""Standard deviation of the prior of the depth scale over that of the sensor's scale, since single sensors are off by far more."""
LEAST_DEVIATION = 1e-4
"""Least standard deviation of the factor, so that a sensor without errors can be fused."""


@dataclass(frozen=True)
class DepthScale:
    """What a sensor's tolerance and landmarks say of the factor that corrects measured depth."""

    deviation: float  # of the factor about 1, by the sensor
    by_landmarks: float | None = (
        None  # from the pose at which they were matched; None if too little was measured
    )

    @staticmethod
    def of(found: LandmarkPose, sensor: DepthSensorModel) -> DepthScale:
        """Return what is known of the depths that a sensor measured with a pose by landmarks."""
        return DepthScale(PRIOR_WIDTH * sensor.scale, found.depth_scale)

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
class JointEquations:
    """A cost of a pose and a factor, and its Gauss-Newton model; the factor is the last of seven unknowns."""

    cost: float
    gradient: Float[Tensor, "7"]
    hessian: Float[Tensor, "7 7"]

    @staticmethod
    def of_pose(equations: NormalEquations) -> JointEquations:
        """Return a cost of one pose as one of both unknowns."""
        embedding = torch.eye(6, 7, dtype=torch.float64)
        return JointEquations.pulled_back(equations, embedding)

    @staticmethod
    def pulled_back(equations: NormalEquations, updates: Float[Tensor, "6 7"]) -> JointEquations:
        """Return a cost of one pose as one of unknowns that update it as ``updates`` tells."""
        gradient, hessian = updates.mT @ equations.gradient[0], updates.mT @ equations.hessian[0] @ updates
        return JointEquations(float(equations.cost[0]), gradient, hessian)

    @staticmethod
    def of_residual(residual: float, jacobian: Float[Tensor, "7"], deviation: float) -> JointEquations:
        """Return the cost of a single residual with that standard deviation."""
        whitened = jacobian / deviation
        value = residual / deviation
        return JointEquations(value**2, value * whitened, torch.outer(whitened, whitened))

    def __add__(self, other: JointEquations) -> JointEquations:
        return JointEquations(
            self.cost + other.cost, self.gradient + other.gradient, self.hessian + other.hessian
        )

    def scaled(self, weight: float) -> JointEquations:
        """Return the equations of the cost multiplied by ``weight``."""
        return JointEquations(weight * self.cost, weight * self.gradient, weight * self.hessian)

    def without_factor(self) -> NormalEquations:
        """Return the equations of the pose alone: the factor takes its best value for each (Schur complement)."""
        coupling, own = self.hessian[:6, 6], self.hessian[6, 6]
        cost = self.cost - self.gradient[6] ** 2 / own
        gradient = self.gradient[:6] - coupling * self.gradient[6] / own
        hessian = self.hessian[:6, :6] - torch.outer(coupling, coupling) / own
        return NormalEquations(cost[None], gradient[None], hessian[None])

    def factor_step(self, step: Float[Tensor, "6"]) -> float:
        """Return the best change of the factor for a step of the pose."""
        return -float((self.gradient[6] + self.hessian[6, :6] @ step) / self.hessian[6, 6])


@dataclass(frozen=True, eq=False)
class ScaledPoints:
    """Measured points on the surface, whose depths share an unknown factor.

    The factor is relative to ``scale.estimate``, by which the points of ``cost`` were corrected from the pose ``start``.
    """

    cost: SurfaceCost
    scale: DepthScale
    start: SE3

    def at(self, factor: float) -> SurfaceCost:
        """Return the cost of the points with their depths multiplied by a factor."""
        cloud = self.cost.cloud
        return replace(
            self.cost,
            cloud=replace(cloud, points=cloud.origins + factor * (cloud.points - cloud.origins)),
        )

    def joint(self, cost: SurfaceCost, equations: NormalEquations) -> JointEquations:
        """Return the equations of points of some factor for one pose as those of pose and factor.

        To first order points that grow by 1 % move like the camera by 1 % of its distance from their middle. The points turn
        about their own middle, the joint updates about that of ``self.cost``.
        """
        cloud = self.cost.cloud
        updates = torch.zeros(6, 7, dtype=torch.float64)
        updates[:, :6] = cost.cloud.pivot.from_other(cloud.pivot)
        updates[:3, 6] = (cloud.middle - cloud.origins.mean(0)).double().cpu()
        return JointEquations.pulled_back(equations, updates)

    def assumed(self, at: PoseAndFactor) -> JointEquations:
        """Return the costs of what the sensor's tolerance and the landmarks say of the factor.

        The factor by landmarks is the ratio of their depths to the measured ones, and so changes with the pose.
        """
        applied, factor = self.scale.estimate, torch.zeros(7, dtype=torch.float64)
        factor[6] = applied
        deviation = max(self.scale.deviation, LEAST_DEVIATION)
        whole = JointEquations.of_residual(applied * at.factor - 1, factor, deviation)
        if self.scale.by_landmarks is None:
            return whole
        middle = self.cost.cloud.middle.double().cpu()
        seen = (at.T.inverse() @ self.start).apply(middle[None])[
            0
        ]  # what was in the middle then, in the camera's frame
        ratio = self.scale.by_landmarks / float(middle[2])
        jacobian = factor.clone()
        jacobian[2], jacobian[3:6] = ratio, -ratio * skew(seen - middle)[2]
        residual = applied * at.factor - ratio * float(seen[2])
        return whole + JointEquations.of_residual(residual, jacobian, LANDMARK_SCALE_NOISE)
