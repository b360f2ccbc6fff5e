"""Fused poses: a prior, measured points of unknown scale and rendered rays together."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Generator

from bidnerf_core.evaluation.errors import pose_error
from bidnerf_core.localization.costs.prior import GaussianPrior
from bidnerf_core.localization.costs.rendered import RenderedCost, RenderedCostSettings
from bidnerf_core.localization.costs.surface import PointCloud, SurfaceCost
from bidnerf_core.localization.depth_scale import DepthScale, ScaledPoints
from bidnerf_core.localization.fused_pose import FusedTerms, fused_pose
from bidnerf_core.localization.fusion import finest_cost
from bidnerf_core.localization.method_settings import ColourSettings, RefinementSettings, RefinementStage
from bidnerf_core.localization.problem import rig
from bidnerf_core.se3 import SE3
from textured_field import textured_map, unseen

TRUTH = unseen().T_ref_camera
OFF = torch.tensor([0.02, -0.01, 0.03, 0.004, -0.006, 0.003], dtype=torch.float64)
WIDE = torch.diag(torch.tensor([0.05] * 3 + [0.02] * 3, dtype=torch.float64) ** 2)
CHI2_99 = 16.8  # of six degrees of freedom


def measured(scale: float = 1.0) -> SurfaceCost:
    """Return the cost of points whose depths are ``scale`` times the true ones."""
    view = unseen()
    assert view.frame.depth is not None
    view = replace(view, frame=replace(view.frame, depth=scale * view.frame.depth))
    surface = textured_map(surface=True).surface
    assert surface is not None
    views = rig(textured_map(), (view,), None).views  # relative to the camera whose pose is sought
    return finest_cost(surface, PointCloud.measured(views, None, 1500, Generator().manual_seed(0)))


def rendered(cost: SurfaceCost, draws: list[float]) -> FusedTerms:
    """Return terms with rendered rays alone; the uncertainties for which they are drawn are noted."""
    problem = rig(textured_map(), (replace(unseen(), frame=replace(unseen().frame, depth=None)),), None)
    settings = RenderedCostSettings(ColourSettings(), None, RefinementSettings())
    generator, about = Generator().manual_seed(0), cost.cloud.pivot

    def draw(T: SE3, surface_sigma: float) -> RenderedCost:
        draws.append(surface_sigma)
        stage = RefinementStage(0, 512, surface_sigma=surface_sigma)
        return settings.drawn(replace(problem, start=T), stage, about, generator)

    return FusedTerms(prior(cost), 1, None, draw)


def prior(cost: SurfaceCost) -> GaussianPrior:
    return GaussianPrior(TRUTH.retract(OFF), WIDE, cost.cloud.pivot)


def scaled(cost: SurfaceCost, scale: DepthScale) -> FusedTerms:
    start = prior(cost)
    return FusedTerms(start, 1, ScaledPoints(cost, scale, start.mean))


def test_a_prior_alone_is_its_own_answer() -> None:
    start = prior(measured())
    T, covariance = fused_pose(FusedTerms(start, 1), 5)
    assert torch.allclose(T.matrix(), start.mean.matrix(), atol=1e-9)
    torch.testing.assert_close(covariance, WIDE, rtol=1e-6, atol=1e-12)


def test_points_of_a_sensor_without_errors_bring_the_pose_to_the_truth() -> None:
    T, covariance = fused_pose(scaled(measured(), DepthScale(0.0)), 8)
    error = pose_error(T, TRUTH)
    assert float(error.translation) < 0.01
    assert float(error.rotation_deg) < 0.3
    assert squared_error(T, covariance) < CHI2_99


@pytest.mark.parametrize("scale", [0.97, 1.03])
def test_a_wrong_scale_moves_a_pose_less_where_the_sensor_may_have_one(scale: float) -> None:
    """A tilted plane alone tells little of the scale; what the sensor may be off by is then in the covariance."""
    cost = measured(scale)
    believed, believed_covariance = fused_pose(scaled(cost, DepthScale(0.0)), 8)
    doubted, covariance = fused_pose(scaled(cost, DepthScale(0.05)), 8)
    assert float(pose_error(doubted, TRUTH).translation) < float(pose_error(believed, TRUTH).translation)
    assert squared_error(doubted, covariance) < CHI2_99 < squared_error(believed, believed_covariance)


def test_rays_bring_the_pose_to_the_truth_and_are_drawn_anew_for_what_is_still_uncertain() -> None:
    draws = list[float]()
    T, covariance = fused_pose(rendered(measured(), draws), 8)
    assert float(pose_error(T, TRUTH).translation) < 0.005
    assert squared_error(T, covariance) < CHI2_99
    assert draws[0] > 2 * draws[-1] > 0


def test_more_steps_are_taken_only_until_the_pose_settles() -> None:
    few, many = list[float](), list[float]()
    cost = measured()
    fused_pose(rendered(cost, few), 2)
    fused_pose(rendered(cost, many), 200)
    assert len(few) == 2
    assert 2 < len(many) < 200


def squared_error(T: SE3, covariance: torch.Tensor) -> float:
    """Return the squared Mahalanobis distance of the true pose."""
    xi = (T.inverse() @ TRUTH).log()
    return float(xi @ torch.linalg.solve(covariance, xi))
