"""Pivots: the points about which pose updates rotate, such as the middle of the visible scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.fields import levels, render
from bidnerf_core.frames import View, draw, observe, uniform
from bidnerf_core.geometry import SE3, skew
from bidnerf_core.localization import Problem

PivotName = Literal["scene", "camera", "world"]


@dataclass(frozen=True, eq=False)
class Pivot:
    """The centre of rotation of updates: a point fixed to the camera, or the world's origin."""

    T_camera_pivot: SE3 | None  # a translation; None: the world's own frame

    @staticmethod
    def at_point(point: Float[Tensor, "3"]) -> Pivot:
        """Return the pivot at a point in the camera's frame (metres), on the device of the point."""
        return Pivot(SE3(torch.eye(3, dtype=torch.float64, device=point.device), point.to(torch.float64)))

    @property
    def lever_arm(self) -> float:
        """Distance (metres) by which a rotation of one radian moves the camera.

        It is 1 in the world's frame, since iNeRF does not balance steps of translation and rotation, and also for a pivot at the
        camera, which no rotation moves.
        """
        reach = 0.0 if self.T_camera_pivot is None else float(self.T_camera_pivot.translation.norm())
        return reach if reach > 0 else 1.0

    def move(self, T: SE3, delta: Float[Tensor, "*h 6"]) -> SE3:
        """Return ``T``, one pose or a batch, after the update ``delta``; differentiable in ``delta``."""
        if self.T_camera_pivot is None:
            return SE3.exp(delta) @ T  # a left update (iNeRF, section 3.1)
        return (T @ self.T_camera_pivot).retract(delta) @ self.T_camera_pivot.inverse()

    def move_linearly(self, T: SE3, delta: Float[Tensor, "*h 6"]) -> SE3:
        """Approximate ``move`` to first order in ``delta``: cheaper, with the same value and derivative at 0."""
        if self.T_camera_pivot is None:
            return retract_linearly(SE3.identity(device=delta.device), delta) @ T
        return retract_linearly(T @ self.T_camera_pivot, delta) @ self.T_camera_pivot.inverse()


def retract_linearly(T: SE3, tangent: Float[Tensor, "*c 6"]) -> SE3:
    """Approximate ``T.retract(tangent)`` to first order in ``tangent``.

    The approximation is cheaper and has the same value and derivative at 0, but elsewhere it is not rigid.
    """
    rho, phi = tangent[..., :3], tangent[..., 3:]
    return SE3(T.rotation + T.rotation @ skew(phi), T.translation + T.rotate(rho))


def pivot(name: PivotName, problem: Problem) -> Pivot:
    """Return a pivot by name: the camera (the paper's), the world's origin (iNeRF's), or the middle of the visible scene.

    For a scene metres away, rotation and sideways translation of the camera change the image in almost the same way. In the
    camera's frame, the objective is therefore a long narrow valley, in which first-order steps are slow. About the middle of the
    visible scene, the two motions decouple.
    """
    if name == "world":
        return Pivot(None)
    return Pivot(SE3.identity()) if name == "camera" else Pivot.at_point(middle_of_view(problem, problem.start))


@torch.no_grad()
def middle_of_view(problem: Problem, T: SE3 | None) -> Float[Tensor, "3"]:
    """Return the median of the measured points or, if there are none, of the points rendered from the pose ``T``; on the CPU.

    The result is in the last camera's frame (metres). It is the middle of the scene's box if nothing is rendered, and 0 without a pose.
    """
    point = measured_middle(problem.views)
    if point is not None:
        return point.to("cpu", torch.float64)
    if problem.depth_rays is not None:
        return problem.depth_rays.points.to(torch.float64).cpu().median(0).values
    if T is None:
        return torch.zeros(3, dtype=torch.float64)
    # The renderings of 128 rays give the middle of the visible scene.
    some = draw(problem.views, 128, uniform, torch.Generator().manual_seed(0), device=problem.device).flattened()
    seen = render(levels(problem.field)[0], some.rays(T.to(problem.device), problem.bounds), problem.bounds.background)
    distance = torch.where(seen.opacity > 0.5, seen.distance / seen.opacity.clamp(min=0.5), torch.nan)
    found = (some.origins + distance[..., None] * some.directions).nanmedian(-2).values.cpu().double()
    if bool(found.isfinite().all()):
        return found
    return T.to("cpu", torch.float64).inverse().apply(torch.tensor(problem.bounds.centre, dtype=torch.float64))


def measured_middle(views: Sequence[View]) -> Float[Tensor, "3"] | None:
    """Return the component-wise median of the measured points, in the views' reference frame; None if there are none.

    Every fourth pixel is used, and fewer in an image with millions of pixels.
    """
    points = []
    for view in views:
        if view.frame.depth is None:
            continue
        number = (view.frame.depth.flatten()[::4] > 0).nonzero()[:, 0]
        number = 4 * number[:: max(1, len(number) // 200_000)]
        width = view.frame.intrinsics.width
        pixels = observe(view, torch.stack([number % width, number // width], dim=-1), torch.float64, "cpu")
        points.append(pixels.points[pixels.measured])
    together = torch.cat(points) if points else torch.zeros((0, 3))
    return together.median(0).values if len(together) else None
