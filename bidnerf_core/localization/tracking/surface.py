"""Alignment of measured depth with the baked surface, from a nearly correct pose.

Depth without colours corrects a prediction along the directions that the shape determines. Points slide along flat walls at no
cost, and in a corridor, the few others, on door frames and edges, fit wrong places about as well as the right one. The prediction
is therefore kept along weak directions (solution remapping, Zhang et al. 2016, "On degeneracy of optimization-based state
estimation problems"), with its uncertainty.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Generator, Tensor

from bidnerf_core.depth import EXACT
from bidnerf_core.frames import Frame, View, observe
from bidnerf_core.geometry import SE3, USUAL, retracted
from bidnerf_core.localization.acceptance import SurfaceDiagnostics, surface_diagnostics
from bidnerf_core.localization.costs.surface import PointCloud, PointScales, SurfaceCost
from bidnerf_core.localization.covariance import (
    FINEST,
    LEAST_VARIANCE,
    finest_cost,
    surface_covariance,
    weight,
)
from bidnerf_core.localization.normal_equations import GaussianPrior, Scaled, Sum
from bidnerf_core.localization.result import Outcome, Verdict
from bidnerf_core.localization.search import JUDGED
from bidnerf_core.localization.solvers.levenberg_marquardt import descend
from bidnerf_core.localization.tracking.motion import PoseEstimate
from bidnerf_core.mapping import SurfaceMap

SURFACE_BIAS = 0.5
"""Fraction of the variance of a pose by depth that is common to consecutive frames."""
DRAWN = 4
"""Number of pixels drawn per requested measured point."""
STEPS = 8
"""Maximum number of steps of an alignment without landmarks, at each scale."""
ALIGNED_STEP = 1e-4
"""Length of a step (metres, radians) below which an alignment ends."""


def measured_cloud(
    frame: Frame,
    count: int,
    scale: float,
    generator: Generator,
    motion: Float[Tensor, "6"] | None = None,
) -> PointCloud:
    """Return up to ``count`` of a frame's measured points in the camera's frame; depth is multiplied by ``scale``.

    ``motion`` is the camera's during the readout, if known. Pixels are drawn without scanning the whole image, which would take
    longer than processing the drawn ones, so a pixel may be drawn twice. If the depth is sparse, all measured pixels are
    candidates.
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
    """Fuse a pose with measured points on the surface, which count as ``USUAL.tracked_points``.

    A fraction ``SURFACE_BIAS`` of the variance contributed by the points is bias, as in ``aligned``.
    """
    cost = finest_cost(surface, cloud)
    unmoved = torch.zeros(6, dtype=torch.float64)
    T, _, information, _ = _descended(cost, pose, pose.T_world_camera, unmoved, steps, whole=True)
    return fused_with_points(T, pose, information)


def fused_with_points(T: SE3, pose: PoseEstimate, information: Float[Tensor, "6 6"]) -> PoseEstimate:
    """Return the estimate at ``T``, with its noise and bias covariances updated by the points' ``information`` matrix."""
    fused = torch.linalg.inv(torch.linalg.inv(pose.covariance) + information)
    kept, by_points = torch.eye(6).double() - fused @ information, fused @ information @ fused
    return PoseEstimate(
        T.polished(),
        kept @ pose.noise @ kept.T + (1 - SURFACE_BIAS) * by_points,
        kept @ pose.bias @ kept.T + SURFACE_BIAS * by_points,
    )


@dataclass(frozen=True, eq=False)
class Alignment:
    """A pose by measured points on the surface alone, with its covariance and the quality of the fit."""

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
    """Align measured points with the surface from a predicted pose; ``spread`` (metres) is their expected initial error.

    Directions that the points do not constrain stay at the prediction.
    """
    about, finest = cloud.pivot, FINEST * surface.cell
    prior, T = GaussianPrior(predicted, covariance, about), predicted
    for distance in (spread, finest) if spread > 1.5 * finest else (finest,):
        cost = SurfaceCost(surface, cloud, PointScales(distance))
        term = Scaled(cost, weight(USUAL.points, float(cost.residual_variance(T[None])[0])))
        T = descend(Sum((prior, term)), T[None], STEPS, about.moved, stop=ALIGNED_STEP).T[0].normalized()
    judge = SurfaceCost(surface, cloud, PointScales(JUDGED * surface.extent))
    found = surface_covariance(SurfaceCost(surface, cloud, PointScales(finest)), T, 1, EXACT)
    return Alignment(T, found, surface_diagnostics(judge, T, torch.inf))


WEAK = 0.1
"""Ratio to the mean information of the three best directions below which the prediction is kept along a direction."""
FORESEEN = 25.0
"""Maximum squared Mahalanobis distance between a prediction and an accepted pose."""
JUDGED_CELLS = 4.0
"""Maximum distance scale at which the fit is evaluated, in cells of the surface's grid. In a large scene, a fraction of its extent
would accept points far off the surface.
"""


@dataclass(frozen=True, eq=False)
class ShapeFit:
    """A prediction corrected by measured points, and how well these then fit the surface."""

    pose: PoseEstimate  # fused with the prediction
    diagnostics: SurfaceDiagnostics
    surprise: float  # squared Mahalanobis distance of the pose from the prediction
    determined: int  # number of directions that the shape determines, of six

    def verdict(self) -> Verdict:
        """Accept or reject the fit; the uncertainty of the position is checked separately."""
        rejected = self.diagnostics.rejection()
        if rejected is not None:
            return rejected
        if self.surprise > FORESEEN:
            why = "the measured shape fits a place that is inconsistent with the motion"
            return Verdict(Outcome.AMBIGUOUS, why)
        share = f"{self.diagnostics.on_surface:.0%} of the measured points lie on the surface"
        of = "" if self.determined == 6 else f", which determines {self.determined} of 6 directions"
        return Verdict(Outcome.CONVERGED, share + of)


def fit_shape(surface: SurfaceMap, cloud: PointCloud, predicted: PoseEstimate, spread: float) -> ShapeFit:
    """Correct a predicted pose by measured points; ``spread`` (metres) is their expected initial error."""
    T, moved = predicted.T_world_camera, torch.zeros(6, dtype=torch.float64)
    finest, information = FINEST * surface.cell, torch.zeros((6, 6), dtype=torch.float64)
    kept = information
    for distance in (spread, finest) if spread > 1.5 * finest else (finest,):
        cost = SurfaceCost(surface, cloud, PointScales(distance, colour_weight=0.0))
        T, moved, information, kept = _descended(cost, predicted, T, moved, STEPS)
    judge = SurfaceCost(
        surface, cloud, PointScales(min(JUDGED * surface.extent, JUDGED_CELLS * surface.cell))
    )
    surprise = float(moved @ torch.linalg.solve(predicted.covariance, moved))
    diagnostics = surface_diagnostics(judge, T, math.inf)
    return ShapeFit(
        fused_with_points(T, predicted, information), diagnostics, surprise, round(float(kept.trace()))
    )


def _descended(
    cost: SurfaceCost,
    predicted: PoseEstimate,
    T: SE3,
    moved: Float[Tensor, "6"],
    steps: int,
    whole: bool = False,
) -> tuple[SE3, Float[Tensor, "6"], Float[Tensor, "6 6"], Float[Tensor, "6 6"]]:
    """Return the pose, its update of the prediction, the points' information, and the projection on the directions they determine.

    With ``whole``, the points also update weak directions.
    """
    about = cost.cloud.pivot
    at_pivot = torch.linalg.inv(about.update_at_camera(T))
    prior = torch.linalg.inv(predicted.covariance)
    for _ in range(steps):
        here, variance = cost.with_variance(T[None])
        # The residuals at an inaccurate prediction do not reflect the noise, so it is re-estimated in each step.
        weight = USUAL.tracked_points / max(float(variance[0]), LEAST_VARIANCE)
        kept = torch.eye(6).double() if whole else _determined(here.hessian[0], cost.cloud)
        hessian = weight * at_pivot.T @ kept.T @ here.hessian[0] @ kept @ at_pivot
        gradient = weight * at_pivot.T @ kept.T @ here.gradient[0]
        # The steps are short enough to be added as vectors; the prior acts on their sum.
        step = -torch.linalg.solve(hessian + prior, gradient + prior @ moved)
        T, moved = retracted(T, step), moved + step
        if float(torch.linalg.vector_norm(step)) < ALIGNED_STEP:
            break
    return T, moved, hessian, kept


def _determined(hessian: Float[Tensor, "6 6"], cloud: PointCloud) -> Float[Tensor, "6 6"]:
    """Return the projection on the directions, of an update at the cloud's middle, that its points determine well."""
    size = float((cloud.points - cloud.middle).square().sum(-1).mean().sqrt())
    unit = torch.tensor(
        [1.0] * 3 + [1 / size] * 3, dtype=torch.float64
    )  # a rotation moves points by about its angle times the size
    values, axes = torch.linalg.eigh(unit[:, None] * hessian * unit)
    good = values >= WEAK * values[3:].mean()
    # Back to updates: x = unit * y, where the axes are orthonormal in y.
    return (unit[:, None] * axes[:, good]) @ (axes[:, good] / unit[:, None]).T
