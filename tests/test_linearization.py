"""Jacobians of what rays see against numerical ones, in float64 on a closed-form scene."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from bidnerf_core.localization.linearization import Linearization, linearize
from bidnerf_core.localization.ray_batch import RayBatch

from bidnerf_core.field import Rays, SceneBounds
from bidnerf_core.localization.exposure import fit_exposure
from bidnerf_core.localization.normal_equations import Losses, residuals
from bidnerf_core.localization.pivots import Pivot
from bidnerf_core.robust import Robust
from bidnerf_core.scenes.fields import GaussianBlobs
from bidnerf_core.scenes.trajectories import orbit
from bidnerf_core.se3 import SE3

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
LOSSES = Losses(Robust("cauchy", 0.2), Robust("cauchy", 0.3))


def batch(count: int = 40) -> RayBatch:
    """Rays towards the scene that measured something else than what is there, some of them no depth."""
    generator = torch.Generator().manual_seed(0)
    across = 0.5 * torch.rand((count, 2), generator=generator, dtype=torch.float64) - 0.25
    directions = torch.nn.functional.normalize(
        torch.cat([across, torch.ones_like(across[:, :1])], -1), dim=-1
    )
    measured = torch.rand((count, 4), generator=generator, dtype=torch.float64)
    measured[:, 3] = torch.where(measured[:, 3] > 0.3, 3.5 + measured[:, 3], 0)
    share = torch.full((count, 4), 1 / count, dtype=torch.float64)
    share[:, 3] *= 2 * (measured[:, 3] > 0)
    return RayBatch(0.05 * measured[:, :3], directions, measured, share)


BATCH = batch()


def held(T: SE3) -> Rays:
    """The interval on each ray says where to look, without a derivative: it stays what it is at POSES."""
    here, moved = BATCH.rays(POSES, BOUNDS), BATCH.rays(T, BOUNDS)
    return replace(moved, near=here.near, far=here.far)


def seen(T: SE3, about: Pivot, least_weight: float = 0.0) -> Linearization:
    return linearize(FIELD, held(T), BATCH.distance, 0.5, about.at(T), BOUNDS.background, least_weight)


@pytest.mark.parametrize("name", list(PIVOTS))
def test_the_jacobian_is_the_numerical_one(name: str) -> None:
    about, step = PIVOTS[name], 1e-5
    exact = seen(POSES, about).jacobian
    for k in range(6):
        xi = step * torch.eye(6, dtype=torch.float64)[k].expand(3, 6)
        ahead, behind = (seen(about.moved(POSES, sign * xi), about).seen for sign in (1, -1))
        torch.testing.assert_close(exact[..., k], (ahead - behind) / (2 * step), rtol=1e-5, atol=1e-7)


def test_steepness_is_the_rate_along_the_steepest_shift() -> None:
    found = seen(POSES, PIVOTS["camera"])
    torch.testing.assert_close(found.steepness, found.jacobian[..., :3].norm(dim=-1))


def test_air_may_be_left_out_of_derivatives() -> None:
    exact, rough = seen(POSES, PIVOTS["scene"]), seen(POSES, PIVOTS["scene"], least_weight=1e-3)
    torch.testing.assert_close(rough.seen, exact.seen)
    assert float((rough.jacobian - exact.jacobian).norm() / exact.jacobian.norm()) < 0.05


def test_channels_that_nobody_asks_for_cost_nothing() -> None:
    only = linearize(
        FIELD, held(POSES), BATCH.distance, 0.5, POSES, BOUNDS.background, channels=(3,)
    ).jacobian
    torch.testing.assert_close(only[..., 3, :], seen(POSES, PIVOTS["camera"]).jacobian[..., 3, :])
    assert float(only[..., :3, :].abs().max()) == 0


def test_rays_that_miss_everything_have_no_derivative() -> None:
    away = BATCH.rays(
        POSES.retract(torch.tensor([0, 0, 0, 3.14, 0, 0], dtype=torch.float64).expand(3, 6)), BOUNDS
    )
    found = linearize(FIELD, away, BATCH.distance, 0.5, POSES, BOUNDS.background)
    assert float(found.jacobian.abs().max()) == 0
    torch.testing.assert_close(found.seen[0, 0, :3], torch.tensor(BOUNDS.background, dtype=torch.float64))
    torch.testing.assert_close(found.seen[..., 3], torch.full((3, 40), 0.5, dtype=torch.float64))


@pytest.mark.parametrize("exposure", [False, True])
def test_the_gradient_of_the_cost_is_the_numerical_one(exposure: bool) -> None:
    """With exposure, the brightness that fits best goes along with the pose; its rounds end near, not at, the best."""
    about, step = PIVOTS["scene"], 1e-5
    exact = residuals(seen(POSES, about), BATCH, LOSSES, exposure).system().gradient
    for k in range(6):
        xi = step * torch.eye(6, dtype=torch.float64)[k].expand(3, 6)
        ahead, behind = (
            residuals(seen(about.moved(POSES, sign * xi), about), BATCH, LOSSES, exposure).system().cost
            for sign in (1, -1)
        )
        allowed = 0.1 * float(exact.abs().max()) if exposure else 1e-8
        torch.testing.assert_close(exact[:, k], (ahead - behind) / (4 * step), rtol=1e-4, atol=allowed)


def test_exposure_is_found() -> None:
    rendered = torch.rand((2, 500, 3), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    gain, bias = torch.tensor([0.8, 1.1, 0.6], dtype=torch.float64), torch.tensor([0.1, -0.05, 0.2]).double()
    measured = gain * rendered[0] + bias
    measured[:50] = 1.0  # outliers
    share = torch.full((500, 3), 1 / 500, dtype=torch.float64)
    found = fit_exposure(rendered[:1], measured, share, Robust("geman-mcclure", 0.05))
    assert float((found.gain - gain).abs().max()) < 0.12  # a gain of 1 has some trust beforehand
    assert float((found.applied(rendered[:1])[0] - measured)[50:].abs().mean()) < 0.03
    plain = fit_exposure(torch.full((1, 500, 3), 0.5).double(), measured, share, Robust("huber", 0.1))
    assert bool(plain.gain.isfinite().all())


def test_what_is_steep_counts_less_and_is_judged_alike() -> None:
    found = seen(POSES, PIVOTS["scene"])
    firm, soft = (residuals(found, BATCH, LOSSES, False, play) for play in (0.0, 0.1))
    torch.testing.assert_close(firm.system().cost, soft.system().cost)
    assert bool((soft.firm <= firm.firm).all())
    assert bool(
        (
            soft.system().hessian.diagonal(dim1=-2, dim2=-1)
            < firm.system().hessian.diagonal(dim1=-2, dim2=-1)
        ).all()
    )
