"""Fused poses: a prior, measured points of unknown scale and rendered rays together; what is known of the scale of depth.

``fused_pose`` and the joint cost of pose and depth are needed here for numerical derivatives, and for terms one by one.
"""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Generator, Tensor

import baked
from bidnerf_core.localization import (
    ColourSettings,
    GaussianPrior,
    Pivot,
    PointCloud,
    PointScales,
    RefinementSettings,
    RefinementStage,
    RenderedCost,
    RenderedCostSettings,
    SurfaceCost,
    rig,
)

# Inside: terms one by one, against numerical derivatives
from bidnerf_core.localization.covariance import finest_cost, position_deviation
from bidnerf_core.localization.depth_scale import (
    LANDMARK_SCALE_NOISE,
    PLAUSIBLE,
    DepthScale,
    PoseAndDepth,
    ScaledPoints,
)
from bidnerf_core.localization.fusion import FusedPose, Measurements, fused_pose
from bidnerf_core.results import normalized_error_squared, pose_error
from bidnerf_core.testing import textured_map, unseen
from localizations import CHI2_99
from problems import FieldMap

TRUTH = unseen().T_ref_camera
OFF = torch.tensor([0.02, -0.01, 0.03, 0.004, -0.006, 0.003], dtype=torch.float64)
WIDE = torch.diag(torch.tensor([0.05] * 3 + [0.02] * 3, dtype=torch.float64) ** 2)


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
    return float(normalized_error_squared(found.T, TRUTH, found.covariance))


def translation_error(found: FusedPose) -> float:
    return float(pose_error(found.T, TRUTH).translation)


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
    for count in (0.0001, 0.01, 1.0):  # with more, the rounding of colours decides
        found = fused_pose(rays(count), 8)
        errors.append(translation_error(found))
        deviations.append(position_deviation(found.covariance))
    assert errors == sorted(errors, reverse=True)
    assert deviations == sorted(deviations, reverse=True)
    assert squared_error(fused_pose(rays(100.0), 8)) < CHI2_99


def test_what_is_not_finite_leaves_the_pose_and_its_covariance() -> None:
    cost = measured()
    broken = replace(cost, cloud=replace(cost.cloud, rgb=torch.full_like(cost.cloud.rgb, math.nan)))
    found = fused_pose(scaled(broken, DepthScale(0.02)), 5)
    assert torch.equal(found.T.matrix(), prior(cost.cloud.pivot).mean.matrix())
    torch.testing.assert_close(found.covariance, WIDE, rtol=1e-6, atol=1e-12)


SCALES = PointScales(0.1, 0.3, 0.7)
SCALE = DepthScale(0.02)


def scaled_points(scale: DepthScale = SCALE, views: int = 1) -> ScaledPoints:
    """Return points of one or more cameras on an exact surface, from their true pose."""
    seen = baked.unseen()[:views]
    relative = rig(FieldMap(baked.FIELD, baked.BOUNDS), seen, None).views
    cloud = PointCloud.measured(relative, None, 150, Generator().manual_seed(0))
    cloud = baked.points(cloud.points.double(), cloud.rgb.double(), cloud.origins.double())
    return ScaledPoints(SurfaceCost(baked.exact(baked.toy()), cloud, SCALES), scale, seen[-1].T_ref_camera)


def away(points: ScaledPoints, generator: Generator, size: float = 0.01) -> PoseAndDepth:
    off = size * torch.randn(6, generator=generator, dtype=torch.float64)
    return PoseAndDepth(points.start.retract(off), 0.98, 0.01)


def moved(points: ScaledPoints, at: PoseAndDepth, unknowns: Tensor) -> PoseAndDepth:
    return at.moved(points.cost.cloud.pivot, unknowns)


@pytest.mark.parametrize("views", [1, 4])
def test_the_gradient_of_points_is_exact_by_pose_and_errors(views: int, generator: Generator) -> None:
    """The points of another factor turn about another middle; the joint updates turn about the same one."""
    points = scaled_points(views=views)
    at = away(points, generator)
    cost = points.at(at)
    found = points.about_middle(cost, cost(at.T[None]))

    def value(unknowns: Tensor) -> float:
        there = moved(points, at, unknowns)
        return float(points.at(there).cost(there.T[None])[0])

    for axis in range(8):
        step = 1e-6 * torch.eye(8, dtype=torch.float64)[axis]
        expected = (value(step) - value(-step)) / 2e-6
        assert 2 * float(found.gradient[0, axis]) == pytest.approx(expected, rel=1e-3, abs=1e-5)


def test_several_cameras_tell_the_factor_and_one_hardly_does() -> None:
    """Points that grow about one camera can nearly be kept in place by moving it; those of four cannot."""
    told = []
    for views in (1, 4):
        points = scaled_points(views=views)
        equations = points.about_middle(
            points.cost, points.at(PoseAndDepth(points.start))(points.start[None])
        )
        own = 1 / torch.linalg.inv(equations.hessian[0])[6, 6]
        told.append(float(own / equations.hessian[0, 6, 6]))
    assert told[0] < 0.2 * told[1]


@pytest.mark.parametrize("views", [1, 4])
def test_what_is_assumed_of_the_factor_has_the_derivative_of_its_cost(
    views: int, generator: Generator
) -> None:
    points = scaled_points(DepthScale(0.02, by_landmarks=1.03), views)
    at = away(points, generator)
    found = points.assumed(at)
    for axis in range(8):
        step = 1e-6 * torch.eye(8, dtype=torch.float64)[axis]
        above, below = (float(points.assumed(moved(points, at, sign * step)).cost[0]) for sign in (1, -1))
        assert 2 * float(found.gradient[0, axis]) == pytest.approx((above - below) / 2e-6, rel=1e-5, abs=1e-3)


def test_a_camera_that_moves_away_shows_landmarks_farther_off() -> None:
    """The measured depths stay as they are, so that their factor has to grow by as much."""
    points = scaled_points(DepthScale(0.5, by_landmarks=1.0))
    middle = points.cost.cloud.middle.double()
    back = torch.cat([-0.1 * middle, torch.zeros(3, dtype=torch.float64)])
    farther = points.cost.cloud.pivot.moved(points.start, back)

    def cost(factor: float) -> float:
        return float(points.assumed(PoseAndDepth(farther, factor)).cost[0])

    factors = torch.linspace(0.9, 1.3, 401).tolist()
    assert min(factors, key=cost) == pytest.approx(1.1, abs=0.01)


@pytest.mark.parametrize("by_landmarks", [None, 1.03, 0.9])
def test_at_the_start_the_most_probable_factor_is_the_estimate(by_landmarks: float | None) -> None:
    """The points were corrected by it already, so that the factor is 1 there."""
    points = scaled_points(DepthScale(0.02, by_landmarks))
    found = points.assumed(PoseAndDepth(points.start))
    assert float(found.gradient[0, 6]) == pytest.approx(0, abs=1e-6)


def test_a_sensor_without_errors_fixes_the_factor() -> None:
    points = scaled_points(DepthScale(0.0, by_landmarks=1.03))
    assert points.scale.estimate == 1
    information = points.assumed(PoseAndDepth(points.start)).hessian[0, 6, 6]
    assert float(information) > 1e3 / LANDMARK_SCALE_NOISE**2


def test_a_scale_is_plausible_as_far_as_sensor_and_landmarks_may_err() -> None:
    most = PLAUSIBLE * math.hypot(0.02, LANDMARK_SCALE_NOISE)
    assert DepthScale(0.02).objection is None
    for sign in (-1, 1):
        assert DepthScale(0.02, 1 + sign * 0.99 * most).objection is None
        assert DepthScale(0.02, 1 + sign * 1.01 * most).objection is not None
        assert DepthScale(0.06, 1 + sign * 1.01 * most).objection is None
    assert DepthScale(0.02, 0.2).objection == "it is 5 times that of the landmarks"
