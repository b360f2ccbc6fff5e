"""The descent of a sum of terms: scipy's minimum, in any frame and unit, each state for itself, and no step from what cannot be solved."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from scipy.optimize import least_squares
from torch import Tensor

from bidnerf_core.geometry import SE3, skew
from bidnerf_core.localization import states_at
from bidnerf_core.mapping import GaussianPrior, Normal, P, States, descend

GENERATOR = torch.Generator().manual_seed(0)
POINTS = torch.randn((40, 3), generator=GENERATOR, dtype=torch.float64) + torch.tensor([0.0, 0, 4])
XI_TRUE = torch.tensor([0.3, -0.2, 0.5, 0.2, 0.4, -0.3], dtype=torch.float64)
NOISE = 0.01 * torch.randn((40, 2), generator=GENERATOR, dtype=torch.float64)
WEIGHT = 1e6
"""Inverse variance of an observation: the descent ends where it expects hardly any more gain in the likelihood."""


def residuals(T: SE3) -> Tensor:
    """Errors of reprojection (h n 2): T takes POINTS to a camera."""
    points = POINTS @ T.rotation.mT + T.translation[..., None, :]
    seen = SE3.exp(XI_TRUE).apply(POINTS)
    return points[..., :2] / points[..., 2:] - seen[:, :2] / seen[:, 2:] - NOISE


def reprojection(states: States) -> Normal:
    T = states.T
    x, y, z = (POINTS @ T.rotation.mT + T.translation[:, None]).unbind(-1)
    zero = torch.zeros_like(x)
    rows = [torch.stack([1 / z, zero, -x / z**2], -1), torch.stack([zero, 1 / z, -y / z**2], -1)]
    local = torch.cat([torch.eye(3, dtype=torch.float64).expand(40, 3, 3), -skew(POINTS)], -1)
    jacobian = (torch.stack(rows, -2) @ T.rotation[:, None] @ local).flatten(1, 2)
    r = residuals(T).flatten(1)
    gradient, hessian = torch.zeros((len(r), P)).double(), torch.zeros((len(r), P, P)).double()
    gradient[:, :6], hessian[:, :6, :6] = (
        WEIGHT * (r[:, None] @ jacobian)[:, 0],
        WEIGHT * jacobian.mT @ jacobian,
    )
    return Normal(WEIGHT / 2 * r.square().sum(-1), gradient, hessian)


def starts(count: int, spread: float = 0.2) -> States:
    generator = torch.Generator().manual_seed(1)
    return states_at(SE3.exp(XI_TRUE + spread * torch.randn((count, 6), generator=generator, dtype=torch.float64)))


@pytest.mark.parametrize("pivot", [None, torch.tensor([0.3, -0.2, 4.0], dtype=torch.float64)])
def test_it_finds_what_scipy_finds(pivot: Tensor | None) -> None:
    oracle = least_squares(
        lambda xi: residuals(SE3.exp(torch.as_tensor(xi, dtype=torch.float64))).flatten().numpy(),
        XI_TRUE.numpy(),
        method="lm",
        xtol=1e-14,
        ftol=1e-14,
        gtol=1e-14,
    )
    path: list[tuple[SE3, Tensor]] = []
    found, normal = descend(starts(8), [reprojection], 30, pivot, path)
    expected = SE3.exp(torch.as_tensor(oracle.x)).matrix().expand(8, 4, 4)
    torch.testing.assert_close(found.T.matrix(), expected, rtol=0, atol=1e-5)
    costs = torch.stack([*(cost for _, cost in path), normal.cost])
    assert bool((costs.diff(dim=0) <= 0).all())
    assert len(path) < 15


def test_states_are_independent_of_each_other() -> None:
    together, _ = descend(starts(5, 0.6), [reprojection], 6)
    alone = [descend(starts(5, 0.6)[i : i + 1], [reprojection], 6)[0].T.matrix() for i in range(5)]
    torch.testing.assert_close(together.T.matrix(), torch.cat(alone), rtol=1e-3, atol=1e-3)


def test_a_sum_of_terms_is_a_term() -> None:
    once, _ = descend(starts(3), [lambda s: reprojection(s) + reprojection(s)], 4)
    twice, _ = descend(starts(3), [reprojection, reprojection], 4)
    torch.testing.assert_close(once.T.matrix(), twice.T.matrix())


@pytest.mark.parametrize(
    "spoil",
    [
        lambda n: Normal(n.cost, 0 * n.gradient, 0 * n.hessian),
        lambda n: Normal(n.cost, n.gradient, -n.hessian),
        lambda n: Normal(n.cost, n.gradient * torch.nan, n.hessian),
        lambda n: Normal(n.cost, n.gradient, n.hessian * torch.inf),
        lambda n: Normal(n.cost * torch.nan, n.gradient, n.hessian * torch.nan),
    ],
    ids=["nothing seen", "not convex", "NaN gradient", "infinite", "all NaN"],
)
def test_what_cannot_be_solved_takes_no_step_and_harms_no_other(spoil: Callable[[Normal], Normal]) -> None:
    def first_spoilt(states: States) -> Normal:
        good = reprojection(states)
        return spoil(good).where(torch.arange(len(states)) == 0, good)

    found, _ = descend(starts(3), [first_spoilt], 20)
    assert torch.equal(found.T[0].matrix(), starts(3).T[0].matrix())
    expected, _ = descend(starts(3), [reprojection], 20)
    torch.testing.assert_close(found.T[1:].matrix(), expected.T[1:].matrix(), rtol=0, atol=1e-5)


def test_a_prior_on_the_pose_is_the_squared_mahalanobis_distance_with_its_derivatives() -> None:
    root = torch.randn((6, 6), generator=GENERATOR, dtype=torch.float64)
    given, states = GaussianPrior(SE3.exp(XI_TRUE), root @ root.T), starts(4, 0.1)
    xi = (given.mean.inverse() @ states.T).log()
    found = given(states)
    torch.testing.assert_close(found.cost, (xi @ given.information * xi).sum(-1) / 2)
    step = 1e-6 * torch.eye(P, dtype=torch.float64)
    ahead, behind = (
        torch.stack([given(states.retract(x.expand(4, P))).cost for x in sign * step], -1) for sign in (1, -1)
    )
    # The third order of the update is left out, a few thousandths of its size.
    torch.testing.assert_close(
        found.gradient, (ahead - behind) / 2e-6, rtol=1e-2, atol=1e-3 * float(found.gradient.abs().max())
    )
    fused, normal = descend(states, [given, reprojection], 20)
    assert float(fused.T.translation.std(0).max()) < 1e-5
    by_image = reprojection(fused).hessian
    torch.testing.assert_close(normal.hessian[:, :6, :6], (by_image + given(fused).hessian)[:, :6, :6])
