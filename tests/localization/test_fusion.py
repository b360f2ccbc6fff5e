"""Fused poses: a prior, measured points of unknown scale and rendered rays together."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Generator, Tensor

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
from bidnerf_core.localization.covariance import finest_cost, position_deviation
from bidnerf_core.localization.depth_scale import DepthScale, PoseAndDepth, ScaledPoints
from bidnerf_core.localization.fusion import Fit, FusedPose, Measurements, fused_pose
from bidnerf_core.results import pose_error
from bidnerf_core.testing import textured_map, unseen

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


def drawn(about: Pivot, seed: int = 0) -> RenderedCost:
    """Return the cost of rays of an image without depth."""
    problem = rig(textured_map(), (replace(unseen(), frame=replace(unseen().frame, depth=None)),), None)
    settings = RenderedCostSettings(ColourSettings(), None, RefinementSettings())
    return settings.drawn(problem, RefinementStage(0, 512), about, Generator().manual_seed(seed))


def prior(about: Pivot, covariance: Tensor = WIDE) -> GaussianPrior:
    return GaussianPrior(TRUTH.retract(OFF), covariance, about)


def rays(independent: float = 100) -> Measurements:
    about = measured().cloud.pivot
    return Measurements(prior(about), None, drawn(about), independent_rays=independent)


def scaled(cost: SurfaceCost, scale: DepthScale, independent: float = 30) -> Measurements:
    start = prior(cost.cloud.pivot)
    return Measurements(start, ScaledPoints(cost, scale, start.mean), independent_points=independent)


def squared_error(found: FusedPose) -> float:
    """Return the squared Mahalanobis distance of the true pose."""
    xi = (found.T.inverse() @ TRUTH).log()
    return float(xi @ torch.linalg.solve(found.covariance, xi))


def translation_error(found: FusedPose) -> float:
    return float(pose_error(found.T, TRUTH).translation)


def test_a_prior_alone_is_its_own_answer() -> None:
    start = prior(measured().cloud.pivot)
    found = fused_pose(Measurements(start), 5)
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
    assert doubted.state.factor == pytest.approx(1 / scale, abs=0.015)
    assert believed.state.factor == pytest.approx(1, abs=1e-3)


def test_landmarks_hold_the_scale_that_they_gave() -> None:
    """Landmarks say 1.05, wrongly, of points that were corrected by it."""
    scale = DepthScale(0.05, by_landmarks=1.05)
    cost = measured(scale.estimate)
    alone, held = (fused_pose(scaled(cost, given), 8).state.factor for given in (DepthScale(0.05), scale))
    assert alone + 0.005 < held < 1


def test_rays_bring_the_pose_to_the_truth() -> None:
    found = fused_pose(rays(), 8)
    assert translation_error(found) < 0.005
    assert squared_error(found) < CHI2_99


def test_steep_rays_count_less_while_what_is_seen_is_uncertain() -> None:
    measurements = rays()
    vague, certain = (measurements.at(PoseAndDepth(TRUTH), sigma).rays for sigma in (0.1, 0.0))
    assert vague is not None
    assert certain is not None
    assert float(vague.equations.hessian[0].trace()) < 0.5 * float(certain.equations.hessian[0].trace())


def test_points_and_rays_together_are_as_certain_as_either_or_more() -> None:
    cost = measured()
    points = scaled(cost, DepthScale(0.02))
    both = fused_pose(replace(points, rays=drawn(cost.cloud.pivot), independent_rays=100), 8)
    assert squared_error(both) < CHI2_99
    for one in (points, rays()):
        alone = fused_pose(one, 8)
        assert position_deviation(both.covariance) < 1.01 * position_deviation(alone.covariance)


def test_a_term_counts_in_the_answer_as_in_its_covariance() -> None:
    """The prior is off, and the truth fits the rays: the more rays are independent, the nearer the answer and the surer."""
    errors, deviations = [], []
    for count in (0.01, 1.0, 100.0):
        found = fused_pose(rays(count), 8)
        errors.append(translation_error(found))
        deviations.append(position_deviation(found.covariance))
    assert errors == sorted(errors, reverse=True)
    assert deviations == sorted(deviations, reverse=True)
    assert squared_error(fused_pose(rays(100.0), 8)) < CHI2_99


def test_steps_are_taken_until_the_pose_settles(monkeypatch: pytest.MonkeyPatch) -> None:
    count, at = [0], Measurements.at

    def counted(self: Measurements, state: PoseAndDepth, deviation: float) -> Fit:
        count[0] += 1
        return at(self, state, deviation)

    monkeypatch.setattr(Measurements, "at", counted)
    fused_pose(rays(), 200)
    assert 2 < count[0] < 20


def test_a_step_that_does_not_lower_the_sum_is_not_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    measurements = rays()
    monkeypatch.setattr(Fit, "cost", lambda self, weighed: math.inf)
    found = fused_pose(measurements, 3)
    assert torch.equal(found.T.matrix(), measurements.prior.mean.matrix())


def test_what_is_not_finite_leaves_the_pose_and_its_covariance() -> None:
    cost = measured()
    broken = replace(cost, cloud=replace(cost.cloud, rgb=torch.full_like(cost.cloud.rgb, math.nan)))
    found = fused_pose(scaled(broken, DepthScale(0.02)), 5)
    assert torch.equal(found.T.matrix(), prior(cost.cloud.pivot).mean.matrix())
    torch.testing.assert_close(found.covariance, WIDE, rtol=1e-6, atol=1e-12)
