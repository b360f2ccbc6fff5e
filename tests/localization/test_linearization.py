"""Jacobians of residuals of rendered rays against numerical ones, in float64 on a closed-form scene."""

from __future__ import annotations

import pytest
import torch

from bidnerf_core.localization.costs import linearization
from bidnerf_core.localization.costs.linearization import linearize
from rendered_rays import BOUNDS, FIELD, MISS, OBJECTIVE, OBSERVED, PIVOTS, POSES, held, seen


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


def test_all_channels_in_one_pass_are_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    expected = seen(POSES, PIVOTS["scene"], least_weight=1e-3)
    monkeypatch.setattr(linearization, "_all_at_once", lambda *_: True)
    found = seen(POSES, PIVOTS["scene"], least_weight=1e-3)
    torch.testing.assert_close(found.jacobian, expected.jacobian)
    torch.testing.assert_close(found.steepness, expected.steepness)
