"""Alignment of measured depth with the baked surface, from a pose that is nearly right."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Generator, Tensor

from bidnerf_core.depth.sensors import EXACT
from bidnerf_core.frames.frame import Frame, View
from bidnerf_core.frames.pixels import observe
from bidnerf_core.geometry.se3 import SE3
from bidnerf_core.localization.acceptance import SurfaceDiagnostics, surface_diagnostics
from bidnerf_core.localization.costs.prior import GaussianPrior
from bidnerf_core.localization.costs.surface import PointCloud, PointScales, SurfaceCost
from bidnerf_core.localization.covariance import FINEST, LEAST_VARIANCE, surface_covariance
from bidnerf_core.localization.fusion import surface_term
from bidnerf_core.localization.normal_equations import Sum
from bidnerf_core.localization.search.by_points import JUDGED
from bidnerf_core.localization.solvers.levenberg_marquardt import descend
from bidnerf_core.localization.tracking.motion import PoseEstimate
from bidnerf_core.localization.tracking.single_pose import retracted
from bidnerf_core.mapping import SurfaceMap

SURFACE_BIAS = 0.5
"""Share of the variance of a pose by depth that consecutive frames share."""
DEPTH_MEASUREMENTS = 3.0
"""Number of independent measurements that a frame's points count as when fused with landmarks: fewer than ``INDEPENDENT``,
which is optimistic for hand-held sensors.
"""
DRAWN = 4
"""Number of pixels that are drawn for each measured point that is wanted."""
ALIGNMENT_STEPS = 8
"""Largest number of steps of an alignment without landmarks, at each of its scales."""
ALIGNED_STEP = 1e-4
"""Length of a step (metres and radians) below which an alignment ends."""


def measured_cloud(
    frame: Frame,
    count: int,
    scale: float,
    generator: Generator,
    motion: Float[Tensor, "6"] | None = None,
) -> PointCloud:
    """Return up to ``count`` of a frame's measured points in the camera's frame; depth is multiplied by ``scale``.

    ``motion`` is that of the camera while its rows were exposed, where it is known.
    Pixels are drawn without scanning the whole image, which would take longer than processing the few that are drawn; a pixel
    may be drawn twice. Where the depth is sparse, every measured pixel is a candidate.
    """
    view, depth = View(frame, SE3.identity(), motion=motion), frame.depth
    assert depth is not None
    drawn = torch.randint(depth.numel(), (DRAWN * count,), generator=generator)
    drawn = drawn[(depth.flatten()[drawn] > 0).nonzero()[:count, 0]]
    if len(drawn) == count:
        width = depth.shape[1]
        seen = observe(view, torch.stack([drawn % width, drawn // width], dim=-1), device="cpu")
        cloud = PointCloud(seen.points, seen.rgb, seen.origins, seen.coloured)
    else:
        cloud = PointCloud.measured((view,), None, count, generator)
    return cloud if scale == 1 else replace(cloud, points=scale * cloud.points)


def fused_with_surface(
    pose: PoseEstimate, surface: SurfaceMap, cloud: PointCloud, steps: int
) -> PoseEstimate:
    """Fuse a pose with measured points on the surface, which count as ``DEPTH_MEASUREMENTS``.

    A share ``SURFACE_BIAS`` of the variance that the points contribute is bias, as in ``aligned``.
    """
    about = cloud.pivot
    cost = SurfaceCost(surface, cloud, PointScales(FINEST * surface.cell))
    here, variance = cost.with_variance(pose.T_world_camera[None])
    weight = DEPTH_MEASUREMENTS / max(float(variance[0]), LEAST_VARIANCE)
    at_camera = about.update_at_camera(pose.T_world_camera)
    prior = at_camera.T @ torch.linalg.inv(pose.covariance) @ at_camera
    T, moved = pose.T_world_camera, torch.zeros(6, dtype=torch.float64)
    for number in range(steps):
        here = cost(T[None]) if number else here
        hessian, gradient = weight * here.hessian[0], weight * here.gradient[0]
        # The steps are short enough to be added as vectors; the prior pulls back by their sum.
        step = -torch.linalg.solve(hessian + prior, gradient + prior @ moved)
        T, moved = retracted(T, at_camera @ step), moved + step
        if float(torch.linalg.vector_norm(step)) < ALIGNED_STEP:
            break
    to_pivot = torch.linalg.inv(at_camera)
    information = to_pivot.T @ hessian @ to_pivot
    return fused_with_points(T, pose, information)


def fused_with_points(T: SE3, pose: PoseEstimate, information: Float[Tensor, "6 6"]) -> PoseEstimate:
    """Return the pose ``T`` with the covariances that ``pose`` has once it is fused with points of this ``information``."""
    fused = torch.linalg.inv(torch.linalg.inv(pose.covariance) + information)
    kept, by_points = torch.eye(6).double() - fused @ information, fused @ information @ fused
    return PoseEstimate(
        T.normalized(),
        kept @ pose.noise @ kept.T + (1 - SURFACE_BIAS) * by_points,
        kept @ pose.bias @ kept.T + SURFACE_BIAS * by_points,
    )


@dataclass(frozen=True, eq=False)
class Alignment:
    """A pose by measured points on the surface alone, with its covariance and how well the points fit."""

    T_world_camera: SE3
    covariance: Float[Tensor, "6 6"]
    diagnostics: SurfaceDiagnostics


def aligned(
    surface: SurfaceMap,
    cloud: PointCloud,
    predicted: SE3,
    covariance: Float[Tensor, "6 6"],
    spread: float,
) -> Alignment:
    """Align measured points with the surface from a predicted pose; ``spread`` (metres) is how far off they may be.

    Where the points do not constrain the pose, it stays at the prediction.
    """
    about, finest = cloud.pivot, FINEST * surface.cell
    prior, T = GaussianPrior(predicted, covariance, about), predicted
    for distance in (spread, finest) if spread > 1.5 * finest else (finest,):
        cost = SurfaceCost(surface, cloud, PointScales(distance))
        term = surface_term(cost, T, 1)
        T = (
            descend(Sum((prior, term.scaled)), T[None], ALIGNMENT_STEPS, about.moved, stop=ALIGNED_STEP)
            .T[0]
            .normalized()
        )
    judge = SurfaceCost(surface, cloud, PointScales(JUDGED * surface.extent))
    found = surface_covariance(SurfaceCost(surface, cloud, PointScales(finest)), T, 1, EXACT)
    return Alignment(T, found, surface_diagnostics(judge, T, torch.inf))
