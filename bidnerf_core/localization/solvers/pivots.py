"""Pivots: the frames of pose updates, whose origins are the centres of rotation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.frames import measured_middle
from bidnerf_core.geometry import SE3
from bidnerf_core.localization.problem import Problem

PivotName = Literal["scene", "camera", "world"]


@dataclass(frozen=True, eq=False)
class Pivot:
    """The centre of rotation of updates: a point fixed to the camera, or the world's origin."""

    T_camera_pivot: SE3 | None  # a translation; None: the world's own frame

    @staticmethod
    def at_point(point: Float[Tensor, "3"]) -> Pivot:
        """Return the pivot at a point given in the camera's frame, metres."""
        return Pivot(SE3(torch.eye(3, dtype=torch.float64), point.to("cpu", torch.float64)))

    def to(self, device: torch.device) -> Pivot:
        """Return the pivot for poses on ``device``."""
        return self if self.T_camera_pivot is None else Pivot(self.T_camera_pivot.to(device))

    @property
    def lever_arm(self) -> float:
        """Distance (metres) by which a rotation of one radian moves the camera, but at least 1.

        It balances steps of translation and rotation. In the world's frame it is 1, since iNeRF does not balance them.
        """
        return 1.0 if self.T_camera_pivot is None else max(1.0, float(self.T_camera_pivot.translation.norm()))

    def moved(self, T: SE3, delta: Float[Tensor, "*h 6"]) -> SE3:
        """Return ``T``, one pose or a batch, after the update ``delta``; differentiable in ``delta``."""
        if self.T_camera_pivot is None:
            return SE3.exp(delta) @ T  # a left update (iNeRF, section 3.1)
        return (T @ self.T_camera_pivot).retract(delta) @ self.T_camera_pivot.inverse()

    def moved_linearly(self, T: SE3, delta: Float[Tensor, "*h 6"]) -> SE3:
        """Return ``moved`` to first order in ``delta``, which is cheaper and has the same value and derivative at 0."""
        if self.T_camera_pivot is None:
            return SE3.identity(device=delta.device).retract_linearly(delta) @ T
        return (T @ self.T_camera_pivot).retract_linearly(delta) @ self.T_camera_pivot.inverse()

    def at(self, T: SE3) -> SE3:
        """Return T_world_pivot, of which ``moved`` is a right update, for poses with any leading axes."""
        return T @ (T.inverse() if self.T_camera_pivot is None else self.T_camera_pivot)

    def at_camera(self, T: SE3, covariance: Float[Tensor, "6 6"]) -> Float[Tensor, "6 6"]:
        """Convert the covariance of an update at the pivot to that of a right update of ``T`` (Sola et al. 2018, eq. 54)."""
        carried = self.update_at_camera(T)
        return carried @ covariance @ carried.mT

    def adjoint_from(self, other: Pivot) -> Float[Tensor, "6 6"]:
        """Return the matrix that converts an update about another point in the camera's frame to one about this point."""
        assert self.T_camera_pivot is not None
        assert other.T_camera_pivot is not None
        return (self.T_camera_pivot.inverse() @ other.T_camera_pivot).adjoint()

    def update_at_camera(self, T: SE3) -> Float[Tensor, "*h 6 6"]:
        """Return the matrix that converts an update at the pivot to the equivalent right update of ``T``."""
        return (T.inverse() if self.T_camera_pivot is None else self.T_camera_pivot).adjoint()


def pivot(name: PivotName, problem: Problem) -> Pivot:
    """Return a pivot by name: the camera (the paper's), the world's origin (iNeRF's), or the middle of the visible scene.

    For a scene metres away, rotation and sideways translation of the camera change the image in almost the same way. In the
    camera's frame, the objective is therefore a long narrow valley, in which first-order steps are slow. About the middle of the
    visible scene, the two motions decouple.
    """
    if name == "world":
        return Pivot(None)
    return Pivot(SE3.identity()) if name == "camera" else Pivot.at_point(_middle(problem))


def _middle(problem: Problem) -> Float[Tensor, "3"]:
    """Return the middle of the measured points, or else of the scene, or else 0; in the last camera's frame, metres."""
    point = measured_middle(problem.views)
    if point is not None:
        return point
    if problem.depth_rays is not None:
        return problem.depth_rays.points.to(torch.float64).cpu().median(0).values
    if problem.start is None:
        return torch.zeros(3, dtype=torch.float64)
    corners = torch.tensor([problem.bounds.lower, problem.bounds.upper], dtype=torch.float64)
    return problem.start.inverse().apply(corners.mean(0))
