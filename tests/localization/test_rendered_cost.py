"""The cost of rendered rays: its gradient is exact, with exposure too, and steep residuals steer but do not judge."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from bidnerf_core.camera import Intrinsics
from bidnerf_core.fields import Objective, colour_term, depth_term, render
from bidnerf_core.frames import Frame
from bidnerf_core.geometry import Robust
from bidnerf_core.localization import RefinementSettings, RefinementStage, RenderedCost
from bidnerf_core.localization.costs.rendered import LEAST_WITH_DEPTH, Residuals, _residuals
from problems import single
from rendered_rays import BOUNDS, FIELD, OBJECTIVE, OBSERVED, PIVOTS, POSES, RAYS, seen


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
