"""Fused poses: a prior, measured points of unknown scale and rendered rays together."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Generator, Tensor

from bidnerf_core.geometry.se3 import SE3
from bidnerf_core.localization import (
    ColourSettings,
    GaussianPrior,
    Pivot,
    PointCloud,
    RefinementSettings,
    RefinementStage,
    RenderedCost,
    RenderedCostSettings,
    SurfaceCost,
    rig,
)
from bidnerf_core.localization.covariance import INDEPENDENT, LEAST_VARIANCE, position_deviation
from bidnerf_core.localization.depth_scale import DepthScale, ScaledPoints
from bidnerf_core.localization.fused_pose import (
    FusedPose,
    Measurements,
    WeightedTerms,
    fused_pose,
)
from bidnerf_core.localization.fusion import finest_cost
from bidnerf_core.results.errors import pose_error
from bidnerf_core.testing.textured_field import textured_map, unseen

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


def drawing(about: Pivot, draws: list[float]) -> Callable[[SE3, float], RenderedCost]:
    """Return what draws rays; the uncertainties of the surfaces for which it does are noted."""
    problem = rig(textured_map(), (replace(unseen(), frame=replace(unseen().frame, depth=None)),), None)
    settings = RenderedCostSettings(ColourSettings(), None, RefinementSettings())
    generator = Generator().manual_seed(0)

    def draw(T: SE3, surface_sigma: float) -> RenderedCost:
        draws.append(surface_sigma)
        stage = RefinementStage(0, 512, surface_sigma=surface_sigma)
        return settings.drawn(replace(problem, start=T), stage, about, generator)

    return draw


def prior(about: Pivot, covariance: Tensor = WIDE) -> GaussianPrior:
    return GaussianPrior(TRUTH.retract(OFF), covariance, about)


def rays(draws: list[float]) -> Measurements:
    about = measured().cloud.pivot
    return Measurements(prior(about), 1, None, drawing(about, draws))


def scaled(cost: SurfaceCost, scale: DepthScale) -> Measurements:
    start = prior(cost.cloud.pivot)
    return Measurements(start, 1, ScaledPoints(cost, scale, start.mean))


def squared_error(found: FusedPose) -> float:
    """Return the squared Mahalanobis distance of the true pose."""
    xi = (found.T.inverse() @ TRUTH).log()
    return float(xi @ torch.linalg.solve(found.covariance, xi))


def translation_error(found: FusedPose) -> float:
    return float(pose_error(found.T, TRUTH).translation)


def test_a_prior_alone_is_its_own_answer() -> None:
    start = prior(measured().cloud.pivot)
    found = fused_pose(Measurements(start, 1), 5)
    assert torch.allclose(found.T.matrix(), start.mean.matrix(), atol=1e-9)
    torch.testing.assert_close(found.covariance, WIDE, rtol=1e-6, atol=1e-12)


def test_points_of_a_sensor_without_errors_bring_the_pose_to_the_truth() -> None:
    found = fused_pose(scaled(measured(), DepthScale(0.0)), 8)
    assert translation_error(found) < 0.01
    assert float(pose_error(found.T, TRUTH).rotation_deg) < 0.3
    assert squared_error(found) < CHI2_99


@pytest.mark.parametrize("scale", [0.97, 1.03])
def test_a_wrong_scale_is_found_where_the_sensor_may_have_one(scale: float) -> None:
    cost = measured(scale)
    believed = fused_pose(scaled(cost, DepthScale(0.0)), 8)
    doubted = fused_pose(scaled(cost, DepthScale(0.05)), 8)
    assert translation_error(doubted) < 0.5 * translation_error(believed)
    assert squared_error(doubted) < CHI2_99 < squared_error(believed)
    assert doubted.factor == pytest.approx(1 / scale, abs=0.015)
    assert believed.factor == pytest.approx(1, abs=1e-3)


def test_landmarks_hold_the_scale_that_they_gave() -> None:
    """Landmarks say 1.05, wrongly, of points that were corrected by it."""
    scale = DepthScale(0.05, by_landmarks=1.05)
    cost = measured(scale.estimate)
    alone, held = (fused_pose(scaled(cost, given), 8).factor for given in (DepthScale(0.05), scale))
    assert alone + 0.005 < held < 1


def test_rays_bring_the_pose_to_the_truth_and_allow_for_what_is_still_uncertain() -> None:
    draws = list[float]()
    measurements = rays(draws)
    found = fused_pose(measurements, 8)
    assert translation_error(found) < 0.005
    assert squared_error(found) < CHI2_99
    assert draws[0] == pytest.approx(position_deviation(measurements.prior.at_pivot))
    assert draws[0] > 1.5 * draws[-1] > 0


def test_points_and_rays_together_are_as_certain_as_either_or_more() -> None:
    cost = measured()
    about = cost.cloud.pivot
    points = scaled(cost, DepthScale(0.02))
    both = fused_pose(replace(points, draw=drawing(about, [])), 8)
    assert squared_error(both) < CHI2_99
    for one in (points, rays([])):
        alone = fused_pose(one, 8)
        assert position_deviation(both.covariance) < 1.01 * position_deviation(alone.covariance)


def test_steps_are_taken_until_the_pose_settles() -> None:
    few, many = list[float](), list[float]()
    fused_pose(rays(few), 2)
    fused_pose(rays(many), 200)
    assert len(few) == 2
    assert 2 < len(many) < 200


def test_the_covariance_counts_rays_as_few_and_allows_for_the_last_step() -> None:
    """At the truth of a prior that is certain of it there is nearly no step, and the information adds up."""
    measurements = rays([])
    about, certain = measurements.prior.pivot, 1e-4 * WIDE
    measurements = replace(measurements, prior=GaussianPrior(TRUTH, certain, about))
    found = fused_pose(measurements, 1)
    draw = drawing(about, [])
    cost = draw(TRUTH, position_deviation(measurements.prior.at_pivot))
    equations, at_prior = cost(TRUTH[None]), measurements.prior(TRUTH[None]).hessian[0]
    by_rays = equations.hessian[0] * (INDEPENDENT / max(float(equations.cost[0]), LEAST_VARIANCE))
    least = about.at_camera(TRUTH, torch.linalg.inv(at_prior + by_rays))
    added = found.covariance - least
    assert float(torch.linalg.eigvalsh(added)[0]) > -1e-6 * float(least.trace())
    assert float(torch.linalg.eigvalsh(added)[-2]) < 1e-3 * float(least.trace())  # a single step, of rank one


def test_a_step_that_does_not_lower_the_sum_is_not_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    measurements = rays([])
    monkeypatch.setattr(WeightedTerms, "cost", lambda self, at: math.inf)
    found = fused_pose(measurements, 3)
    assert torch.equal(found.T.matrix(), measurements.prior.mean.matrix())


def test_what_is_not_finite_leaves_the_pose_and_its_covariance() -> None:
    cost = measured()
    broken = replace(cost, cloud=replace(cost.cloud, rgb=torch.full_like(cost.cloud.rgb, math.nan)))
    found = fused_pose(scaled(broken, DepthScale(0.02)), 5)
    assert torch.equal(found.T.matrix(), prior(cost.cloud.pivot).mean.matrix())
    torch.testing.assert_close(found.covariance, WIDE, rtol=1e-6, atol=1e-12)
