"""Depth scales: joint equations of pose and factor, and measured points that share a factor."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Generator, Tensor

import baked
from bidnerf_core.localization.costs.surface import PointScales, SurfaceCost
from bidnerf_core.localization.depth_scale import (
    LANDMARK_SCALE_NOISE,
    DepthScale,
    JointEquations,
    PoseAndFactor,
    ScaledPoints,
)
from bidnerf_core.localization.normal_equations import NormalEquations

SCALES = PointScales(0.1, 0.3, 0.7)
SCALE = DepthScale(0.02)


def random(generator: Generator) -> JointEquations:
    rows = torch.randn((20, 7), generator=generator, dtype=torch.float64)
    return JointEquations(3.0, torch.randn(7, generator=generator, dtype=torch.float64), rows.mT @ rows)


def model(equations: JointEquations, unknowns: Tensor) -> Tensor:
    linear = 2 * equations.gradient @ unknowns
    return equations.cost + linear + unknowns @ equations.hessian @ unknowns


def scaled_points(scale: DepthScale = SCALE) -> ScaledPoints:
    view = baked.unseen()[0]
    seen = baked.cloud(view, count=150)
    cloud = baked.points(seen.points.double(), seen.rgb.double(), seen.origins.double())
    return ScaledPoints(SurfaceCost(baked.exact(baked.toy()), cloud, SCALES), scale, view.T_ref_camera)


def test_elimination_solves_for_pose_and_factor_at_once(generator: Generator) -> None:
    joint = random(generator)
    reduced = joint.without_factor()
    step = reduced.solve(torch.zeros(1, dtype=torch.float64))[0]
    both = -torch.linalg.solve(joint.hessian, joint.gradient)
    torch.testing.assert_close(step, both[:6], rtol=1e-6, atol=1e-9)
    assert joint.factor_step(step) == pytest.approx(float(both[6]), rel=1e-6)
    expected = torch.linalg.inv(joint.hessian)[:6, :6]
    torch.testing.assert_close(torch.linalg.inv(reduced.hessian[0]), expected)


def test_the_reduced_cost_is_that_of_the_best_factor(generator: Generator) -> None:
    joint = random(generator)
    step = 0.1 * torch.randn(6, generator=generator, dtype=torch.float64)
    best = torch.cat([step, torch.tensor([joint.factor_step(step)], dtype=torch.float64)])
    reduced = joint.without_factor()
    there = reduced.cost[0] + 2 * reduced.gradient[0] @ step + step @ reduced.hessian[0] @ step
    assert float(there) == pytest.approx(float(model(joint, best)))
    for off in (-0.1, 0.1):
        aside = best + off * torch.eye(7, dtype=torch.float64)[6]
        assert float(model(joint, aside)) > float(there)


@pytest.mark.parametrize("factor", [1.0, 0.95])
def test_the_gradient_of_points_by_the_pose_is_exact_at_any_factor(
    factor: float, generator: Generator
) -> None:
    """The points of another factor turn about another middle; the joint updates turn about the same one."""
    points = scaled_points()
    T = points.start.retract(0.02 * torch.randn(6, generator=generator, dtype=torch.float64))
    cost, pivot = points.at(factor), points.cost.cloud.pivot
    found = points.joint(cost, cost(T[None]))

    def at(delta: Tensor) -> float:
        return float(cost.cost(pivot.moved(T, delta)[None])[0])

    for axis in range(6):
        step = 1e-6 * torch.eye(6, dtype=torch.float64)[axis]
        expected = (at(step) - at(-step)) / 2e-6
        assert 2 * float(found.gradient[axis]) == pytest.approx(expected, rel=1e-3, abs=1e-6)


def test_points_that_grow_are_kept_in_place_by_the_camera_that_moves_back(generator: Generator) -> None:
    """Points about one distance away: growth and motion along the line of sight are the same to first order."""
    points = scaled_points()
    joint = points.joint(points.cost, points.cost(points.start[None]))
    cloud = points.cost.cloud
    away = (cloud.middle - cloud.origins.mean(0)).double()
    unknowns = torch.cat([-away, torch.zeros(3, dtype=torch.float64), torch.ones(1, dtype=torch.float64)])
    assert float(unknowns @ joint.hessian @ unknowns) == pytest.approx(
        0, abs=1e-6 * float(joint.hessian.trace())
    )


def test_what_is_assumed_of_the_factor_has_the_derivative_of_its_cost(generator: Generator) -> None:
    points = scaled_points(DepthScale(0.02, by_landmarks=1.03))
    pivot = points.cost.cloud.pivot
    T = points.start.retract(0.02 * torch.randn(6, generator=generator, dtype=torch.float64))
    found = points.assumed(PoseAndFactor(T, 0.99))

    def at(unknowns: Tensor) -> float:
        return points.assumed(PoseAndFactor(pivot.moved(T, unknowns[:6]), 0.99 + float(unknowns[6]))).cost

    for axis in range(7):
        step = 1e-6 * torch.eye(7, dtype=torch.float64)[axis]
        expected = (at(step) - at(-step)) / 2e-6
        assert 2 * float(found.gradient[axis]) == pytest.approx(expected, rel=1e-5, abs=1e-3)


def test_at_the_start_the_most_probable_factor_is_the_estimate() -> None:
    """The points were corrected by it already, so that the factor is 1 there."""
    for by_landmarks in (None, 1.03, 0.9):
        points = scaled_points(DepthScale(0.02, by_landmarks))
        found = points.assumed(PoseAndFactor(points.start))
        assert float(found.gradient[6]) == pytest.approx(0, abs=1e-6)


def test_a_sensor_without_errors_fixes_the_factor() -> None:
    points = scaled_points(DepthScale(0.0, by_landmarks=1.03))
    assert points.scale.estimate == 1
    information = points.assumed(PoseAndFactor(points.start)).hessian[6, 6]
    assert float(information) > 1e3 / LANDMARK_SCALE_NOISE**2


def test_a_cost_of_the_pose_says_nothing_of_the_factor(generator: Generator) -> None:
    rows = torch.randn((1, 20, 6), generator=generator, dtype=torch.float64)
    gradient = torch.randn((1, 6), generator=generator, dtype=torch.float64)
    equations = NormalEquations(torch.ones(1, dtype=torch.float64), gradient, rows.mT @ rows)
    joint = JointEquations.of_pose(equations)
    assert not bool(joint.hessian[6].any())
    torch.testing.assert_close(joint.hessian[:6, :6], equations.hessian[0])
    fixed = joint + JointEquations.of_residual(0.0, torch.eye(7, dtype=torch.float64)[6], 1.0)
    torch.testing.assert_close(fixed.without_factor().hessian, equations.hessian)


def test_points_of_another_factor_are_as_far_off_as_it_says() -> None:
    points = scaled_points()
    moved, given = points.at(1.1).cloud, points.cost.cloud
    torch.testing.assert_close(moved.points - given.origins, 1.1 * (given.points - given.origins))
    assert torch.equal(replace(moved, points=given.points).rgb, given.rgb)
