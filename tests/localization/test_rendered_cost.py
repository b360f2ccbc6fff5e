"""The cost of rendered rays: exact derivatives, with exposure too; drawn rays and their weights; steep residuals steer but do not judge.

Rays of a closed-form scene have measurements that differ from it. The linearization and the residuals are needed here for numerical
derivatives, which no answer shows.
"""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Generator

import blob_images
from bidnerf_core.camera import Intrinsics
from bidnerf_core.fields import Objective, Observations, Rays, SceneBounds, colour_term, depth_term, render
from bidnerf_core.frames import Frame, View
from bidnerf_core.geometry import SE3, Robust
from bidnerf_core.localization import (
    ColourSettings,
    DepthSettings,
    Pivot,
    RayCounts,
    RefinementSettings,
    RefinementStage,
    RenderedCost,
    objective_of,
    rig,
)

# Inside: residuals of single rays and their derivatives, compared with differences
from bidnerf_core.localization.costs.linearization import Linearization, linearize
from bidnerf_core.localization.costs.rendered import (
    LEAST_WITH_DEPTH,
    Residuals,
    WeightedRays,
    _residuals,
    blurred,
    draw_weighted_rays,
)
from bidnerf_core.scenes import GaussianBlobs, orbit
from problems import FieldMap, single
from tiny import depth_rays_of

BOUNDS = SceneBounds((-2.0, -2.0, -2.0), (2.0, 2.0, 2.0), 0.1, 12.0, (1.0, 0.9, 0.8))
FIELD = GaussianBlobs.random()
POSES = SE3.stack(orbit(4.0, 3, seed=1))
PIVOTS = {
    "camera": Pivot(SE3.identity()),
    "scene": Pivot(
        SE3(torch.eye(3, dtype=torch.float64), torch.tensor([0.1, -0.2, 3.9], dtype=torch.float64))
    ),
    "world": Pivot(None),
}
MISS = 0.5
OBJECTIVE = Objective((colour_term(Robust("cauchy", 0.2)), depth_term(Robust("cauchy", 0.3), 2.0, miss=MISS)))


def observations(count: int = 40) -> Observations:
    """Return rays towards the scene that measured something else than what is there, some of them no depth."""
    generator = torch.Generator().manual_seed(0)
    across = 0.5 * torch.rand((count, 2), generator=generator, dtype=torch.float64) - 0.25
    directions = torch.nn.functional.normalize(
        torch.cat([across, torch.ones_like(across[:, :1])], -1), dim=-1
    )
    measured = torch.rand((count, 4), generator=generator, dtype=torch.float64)
    distance = torch.where(measured[:, 3] > 0.3, 3.5 + measured[:, 3], 0)
    coloured = torch.ones(count, dtype=torch.bool)
    return Observations(0.05 * measured[:, :3], directions, measured[:, :3], distance, coloured)


OBSERVED = observations()
RAYS = WeightedRays(OBSERVED, OBJECTIVE.weights(OBSERVED[None])[0])


def held(T: SE3) -> Rays:
    """Return the rays from T on the intervals that they have at POSES: an interval has no derivative."""
    here, moved = OBSERVED.rays(POSES, BOUNDS), OBSERVED.rays(T, BOUNDS)
    return replace(moved, near=here.near, far=here.far)


def seen(T: SE3, about: Pivot, least_weight: float = 0.0) -> Linearization:
    return linearize(
        FIELD, held(T), OBSERVED, OBJECTIVE.residuals, about.at(T), BOUNDS.background, least_weight
    )


def residuals(about: str, exposure: bool = False, surface_sigma: float = 0.0) -> Residuals:
    return _residuals(seen(POSES, PIVOTS[about]), RAYS, OBJECTIVE, exposure, surface_sigma)


@pytest.mark.parametrize("exposure", [False, True])
def test_the_gradient_of_the_cost_is_the_numerical_one(exposure: bool) -> None:
    """The exposure that fits best changes with the pose; its rounds end near, not at, the best."""
    about, step = PIVOTS["scene"], 1e-5
    exact = residuals("scene", exposure).normal_equations().gradient
    for k in range(6):
        xi = step * torch.eye(6, dtype=torch.float64)[k].expand(3, 6)
        ahead, behind = (
            _residuals(seen(about.moved(POSES, sign * xi), about), RAYS, OBJECTIVE, exposure, 0.0).cost()
            for sign in (1, -1)
        )
        allowed = 0.1 * float(exact.abs().max()) if exposure else 1e-8
        torch.testing.assert_close(exact[:, k], (ahead - behind) / (4 * step), rtol=1e-4, atol=allowed)


def test_clipped_colours_are_explained_and_do_not_steer() -> None:
    """What a camera renders white, of whatever brightness, agrees with a field that is that bright or brighter."""
    found = seen(POSES, PIVOTS["scene"])
    bright = 1.15 * found.rgb[0]
    clipped = bright > 1
    assert 0.02 < float(clipped.double().mean()) < 0.5
    overexposed = replace(RAYS, observed=replace(RAYS.observed, rgb=bright.clamp(max=1)))
    corrected = _residuals(found, overexposed, OBJECTIVE, True, 0.0)
    colours = corrected.value[0, :, :3]
    assert float(colours.abs().max()) < 0.02
    assert not bool(corrected.jacobian[0, :, :3][clipped & (colours == 0)].any())


def test_the_cost_is_twice_the_loss_of_the_objective() -> None:
    """Adam and Levenberg-Marquardt minimise one function: the weighted sum of rho is the loss."""
    found = residuals("camera").cost()
    for i in range(3):
        rays = OBSERVED[None].rays(POSES[i], BOUNDS)
        loss = OBJECTIVE.loss(render(FIELD, rays, BOUNDS.background), OBSERVED[None])
        assert float(found[i]) == pytest.approx(2 * float(loss), rel=1e-6)


def test_steep_residuals_steer_less_and_are_judged_alike() -> None:
    confident, cautious = (residuals("scene", surface_sigma=sigma) for sigma in (0.0, 0.1))
    torch.testing.assert_close(confident.cost(), cautious.cost())
    assert bool((cautious.confidence <= confident.confidence).all())
    one, other = (
        found.normal_equations().hessian.diagonal(dim1=-2, dim2=-1) for found in (cautious, confident)
    )
    assert bool((one < other).all())


def test_inliers_are_rays_none_of_whose_residuals_is_far_off() -> None:
    """Three scales are the limit, of each channel that has a weight."""
    objective = Objective((colour_term(Robust("huber", 0.1)),))
    value = torch.tensor([[[0.29, 0, 0], [0.31, 0, 0], [0, 0, -0.31], [9.0, 9.0, 9.0]]], dtype=torch.float64)
    weights = torch.ones((4, 3), dtype=torch.float64)
    weights[3] = 0
    found = Residuals(
        value, torch.zeros((1, 4, 3, 6)).double(), weights, torch.zeros_like(value), 0.0, objective
    )
    assert found.inliers().tolist() == [0.5]


def test_rays_without_depth_are_left_out_of_the_inliers_by_depth() -> None:
    """Something too near for the sensor hides half of the image: all rays with depth agree, those without do not."""
    objective = Objective((colour_term(Robust("huber", 0.1)), depth_term(Robust("huber", 0.1), 1.0)))
    value = torch.zeros((1, 100, 4), dtype=torch.float64)
    value[:, 50:, 0] = 1.0
    weights = torch.ones(value.shape[1:], dtype=torch.float64)
    fewest = round(100 * LEAST_WITH_DEPTH)
    weights[fewest:, 3] = 0
    found = Residuals(value, torch.zeros((*value.shape, 6)), weights, torch.zeros_like(value), 0.0, objective)
    assert found.inliers().tolist() == [0.5]
    assert found.inliers_by_depth().tolist() == [1.0]
    weights[fewest - 1, 3] = 0  # one fewer, and all rays count again
    assert found.inliers_by_depth().tolist() == [0.5]


def test_the_cost_without_derivatives_is_the_same() -> None:
    blank = Frame("blank", torch.ones((4, 4, 3)), Intrinsics(4.0, 4.0, 2.0, 2.0, 4, 4))
    problem = single(FIELD, BOUNDS, blank, POSES[0])
    cost = RenderedCost(
        problem, RAYS, OBJECTIVE, RefinementStage(1, 40), RefinementSettings(), PIVOTS["scene"]
    )
    torch.testing.assert_close(cost.cost(POSES), cost(POSES).cost)
    assert not bool(cost.residuals(POSES, derivatives=False).jacobian.any())


@pytest.mark.parametrize("name", list(PIVOTS))
def test_the_jacobian_is_the_numerical_one(name: str) -> None:
    about, step = PIVOTS[name], 1e-5
    exact = seen(POSES, about).jacobian
    for k in range(6):
        xi = step * torch.eye(6, dtype=torch.float64)[k].expand(3, 6)
        ahead, behind = (seen(about.moved(POSES, sign * xi), about).residuals for sign in (1, -1))
        torch.testing.assert_close(exact[..., k], (ahead - behind) / (2 * step), rtol=1e-5, atol=1e-7)


def test_steepness_is_the_rate_along_the_steepest_shift() -> None:
    found = seen(POSES, PIVOTS["camera"])
    torch.testing.assert_close(found.steepness, found.jacobian[..., :3].norm(dim=-1))


def test_air_may_be_left_out_of_derivatives() -> None:
    exact, rough = seen(POSES, PIVOTS["scene"]), seen(POSES, PIVOTS["scene"], least_weight=1e-3)
    torch.testing.assert_close(rough.residuals, exact.residuals)
    assert float((rough.jacobian - exact.jacobian).norm() / exact.jacobian.norm()) < 0.05


def test_only_the_channels_asked_for_are_differentiated() -> None:
    only = linearize(
        FIELD, held(POSES), OBSERVED, OBJECTIVE.residuals, POSES, BOUNDS.background, channels=(3,)
    ).jacobian
    torch.testing.assert_close(only[..., 3, :], seen(POSES, PIVOTS["camera"]).jacobian[..., 3, :])
    assert float(only[..., :3, :].abs().max()) == 0


def test_rays_that_miss_everything_have_no_derivative() -> None:
    away = OBSERVED.rays(
        POSES.retract(torch.tensor([0, 0, 0, 3.14, 0, 0], dtype=torch.float64).expand(3, 6)), BOUNDS
    )
    found = linearize(FIELD, away, OBSERVED, OBJECTIVE.residuals, POSES, BOUNDS.background)
    assert float(found.jacobian.abs().max()) == 0
    background = torch.tensor(BOUNDS.background, dtype=torch.float64)
    torch.testing.assert_close(found.rgb, background.expand(3, 40, 3))
    torch.testing.assert_close(found.residuals[..., :3], (background - OBSERVED.rgb).expand(3, 40, 3))
    missed = torch.where(OBSERVED.measured, MISS, 0.0).double()
    torch.testing.assert_close(found.residuals[..., 3], missed.expand(3, 40))


@pytest.mark.parametrize("size", [2, 3, 7, 100])
def test_blur_keeps_means_and_places(size: int) -> None:
    """An image that changes evenly stays what it is, away from its borders."""
    u, v = blob_images.CAMERA.pixel_centres().unbind(-1)
    even = Frame("even", torch.stack([u / 48, v / 40, torch.full_like(u, 0.3)], -1), blob_images.CAMERA)
    smooth = blurred(View(even, blob_images.TRUTH), size).frame.rgb
    assert smooth.shape == even.rgb.shape
    torch.testing.assert_close(smooth[..., 2], even.rgb[..., 2])
    inner = smooth[size : -2 * size, size : -2 * size] - even.rgb[size : -2 * size, size : -2 * size]
    assert inner.numel() == 0 or float(inner.abs().max()) < 1e-5


def test_weights_of_each_kind_of_measurement_add_up_to_its_weight_in_the_objective() -> None:
    """Colours of all pixels and each channel to 1, depths of each sensor to lambda_d."""
    views = [View(blob_images.photograph(T), T) for T in blob_images.POSES]
    objective = objective_of(ColourSettings(), DepthSettings(depth_weight=3.0))
    problem = rig(FieldMap(blob_images.FIELD, blob_images.BOUNDS), views, None)
    drawn = draw_weighted_rays(problem, objective, RayCounts(90), "uniform", 1, Generator().manual_seed(0))
    torch.testing.assert_close(drawn.weights.sum(0), torch.tensor([1.0, 1.0, 1.0, 3.0]))
    assert not bool(drawn.weights[~drawn.observed.measured][:, 3].any())


def test_rays_of_depth_join_pixels_unless_depth_has_no_weight() -> None:
    lidar = depth_rays_of([View(blob_images.FRAME, SE3.identity())])
    problem = single(
        blob_images.FIELD, blob_images.BOUNDS, blob_images.photograph(depth=False), blob_images.TRUTH, lidar
    )
    for weight, count, expected in ((2.0, 40, 90), (2.0, 0, 50), (0.0, 40, 50)):
        objective = objective_of(ColourSettings(), DepthSettings(depth_weight=weight))
        drawn = draw_weighted_rays(
            problem, objective, RayCounts(50, count), "uniform", 1, Generator().manual_seed(0)
        )
        assert len(drawn.observed) == len(drawn.weights) == expected
        assert not bool(drawn.weights[50:, :3].any())
        torch.testing.assert_close(
            drawn.weights[50:, 3:].sum(), torch.tensor(weight if count and weight else 0.0)
        )
