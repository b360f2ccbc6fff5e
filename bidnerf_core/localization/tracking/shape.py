"""Alignment of depth without colours with the baked surface: a prediction is corrected where the shape determines it.

Points slide along flat walls at no cost, and in a corridor the few that do not, on door frames and edges, fit wrong places
about as well as the right one. A weak direction is therefore left to the prediction altogether (solution remapping, Zhang et
al. 2016, "On degeneracy of optimization-based state estimation problems"); its uncertainty then stays that of the prediction.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.geometry.se3 import SE3
from bidnerf_core.localization.acceptance import SurfaceDiagnostics, surface_diagnostics
from bidnerf_core.localization.costs.surface import PointCloud, PointScales, SurfaceCost
from bidnerf_core.localization.covariance import FINEST, LEAST_VARIANCE
from bidnerf_core.localization.result import Outcome, Verdict
from bidnerf_core.localization.search.by_points import JUDGED
from bidnerf_core.localization.tracking.alignment import ALIGNED_STEP, DEPTH_MEASUREMENTS, fused_with_points
from bidnerf_core.localization.tracking.motion import PoseEstimate
from bidnerf_core.localization.tracking.single_pose import retracted
from bidnerf_core.mapping import SurfaceMap

WEAK = 0.1
"""Share of the mean information of the three best directions below which a direction is left to the prediction."""
SHAPE_STEPS = 8
"""Largest number of steps at each scale."""
FORESEEN = 25.0
"""Largest squared Mahalanobis distance between a prediction and an accepted pose."""
JUDGED_CELLS = 4.0
"""Largest scale of distances at which the fit is judged, in cells of the surface's grid. In a large scene, a share of its
extent would accept points that are far off the surface.
"""


@dataclass(frozen=True, eq=False)
class ShapeFit:
    """A prediction corrected by measured points, and how well these then lie on the surface."""

    pose: PoseEstimate  # fused with the prediction
    diagnostics: SurfaceDiagnostics
    surprise: float  # squared Mahalanobis distance of the pose from the prediction
    determined: int  # number of directions that the shape determines, of six

    def verdict(self) -> Verdict:
        """Judge the fit; whether the position is certain enough is judged separately."""
        rejected = self.diagnostics.rejection()
        if rejected is not None:
            return rejected
        if self.surprise > FORESEEN:
            why = "the measured shape fits a place that the motion does not lead to"
            return Verdict(Outcome.AMBIGUOUS, why)
        share = f"{self.diagnostics.on_surface:.0%} of the measured points lie on the surface"
        of = "" if self.determined == 6 else f", which determines {self.determined} of 6 directions"
        return Verdict(Outcome.CONVERGED, share + of)


def fit_shape(surface: SurfaceMap, cloud: PointCloud, predicted: PoseEstimate, spread: float) -> ShapeFit:
    """Correct a predicted pose by measured points; ``spread`` (metres) is how far off they may be."""
    T, moved = predicted.T_world_camera, torch.zeros(6, dtype=torch.float64)
    finest, information = FINEST * surface.cell, torch.zeros((6, 6), dtype=torch.float64)
    kept = information
    for distance in (spread, finest) if spread > 1.5 * finest else (finest,):
        cost = SurfaceCost(surface, cloud, PointScales(distance, colour_weight=0.0))
        T, moved, information, kept = _descended(cost, predicted, T, moved)
    judge = SurfaceCost(
        surface, cloud, PointScales(min(JUDGED * surface.extent, JUDGED_CELLS * surface.cell))
    )
    surprise = float(moved @ torch.linalg.solve(predicted.covariance, moved))
    diagnostics = surface_diagnostics(judge, T, math.inf)
    return ShapeFit(
        fused_with_points(T, predicted, information), diagnostics, surprise, round(float(kept.trace()))
    )


def _descended(
    cost: SurfaceCost, predicted: PoseEstimate, T: SE3, moved: Float[Tensor, "6"]
) -> tuple[SE3, Float[Tensor, "6"], Float[Tensor, "6 6"], Float[Tensor, "6 6"]]:
    """Return the pose, its update of the prediction, the points' information and the projection on what they determine."""
    about = cost.cloud.pivot
    at_pivot = torch.linalg.inv(about.update_at_camera(T))
    prior = torch.linalg.inv(predicted.covariance)
    for _ in range(SHAPE_STEPS):
        here, variance = cost.with_variance(T[None])
        # The residuals at a prediction that is off do not reflect the noise, so it is estimated anew in each step.
        weight = DEPTH_MEASUREMENTS / max(float(variance[0]), LEAST_VARIANCE)
        kept = _determined(here.hessian[0], cost.cloud)
        hessian = weight * at_pivot.T @ kept.T @ here.hessian[0] @ kept @ at_pivot
        gradient = weight * at_pivot.T @ kept.T @ here.gradient[0]
        # The steps are short enough to be added as vectors; the prior pulls back by their sum.
        step = -torch.linalg.solve(hessian + prior, gradient + prior @ moved)
        T, moved = retracted(T, step), moved + step
        if float(torch.linalg.vector_norm(step)) < ALIGNED_STEP:
            break
    return T, moved, hessian, kept


def _determined(hessian: Float[Tensor, "6 6"], cloud: PointCloud) -> Float[Tensor, "6 6"]:
    """Return the projection on the directions of an update at the cloud's middle that its points determine well."""
    size = float((cloud.points - cloud.middle).square().sum(-1).mean().sqrt())
    unit = torch.tensor(
        [1.0] * 3 + [1 / size] * 3, dtype=torch.float64
    )  # a rotation moves points by about its angle times the size
    values, axes = torch.linalg.eigh(unit[:, None] * hessian * unit)
    good = values >= WEAK * values[3:].mean()
    # Back to updates: x = unit * y, where the axes are orthonormal in y.
    return (unit[:, None] * axes[:, good]) @ (axes[:, good] / unit[:, None]).T
