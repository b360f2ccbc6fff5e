"""Damped steps for many poses: they come to what scipy finds, never uphill, and what cannot be solved stays where it is."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from jaxtyping import Float
from scipy.optimize import least_squares
from torch import Tensor

from bidnerf_core.localization.solvers.levenberg_marquardt import System, descend, solve
from bidnerf_core.se3 import SE3, skew

GENERATOR = torch.Generator().manual_seed(0)
POINTS = torch.randn((40, 3), generator=GENERATOR, dtype=torch.float64) + torch.tensor([0.0, 0, 4])
XI_TRUE = torch.tensor([0.3, -0.2, 0.5, 0.2, 0.4, -0.3], dtype=torch.float64)
NOISE = 0.01 * torch.randn((40, 2), generator=GENERATOR, dtype=torch.float64)


def projected(points: Float[Tensor, "*h n 3"]) -> Float[Tensor, "*h n 2"]:
    return points[..., :2] / points[..., 2:]


SEEN = projected(SE3.exp(XI_TRUE).apply(POINTS)) + NOISE


def residuals(T: SE3) -> Float[Tensor, "*h n 2"]:
    """Of reprojection: T takes POINTS to a camera that saw them at SEEN."""
    points = T.rotation[..., None, :, :] @ POINTS[..., None]
    return projected(points[..., 0] + T.translation[..., None, :]) - SEEN


def evaluate(T: SE3) -> System:
    """Sum of squares with its analytic 6-column Jacobian for right updates."""
    points = (T.rotation[:, None] @ POINTS[..., None])[..., 0] + T.translation[:, None]
    x, y, z = points.unbind(-1)
    zero = torch.zeros_like(x)
    by_point = torch.stack(
        [torch.stack([1 / z, zero, -x / z**2], -1), torch.stack([zero, 1 / z, -y / z**2], -1)], -2
    )
    local = torch.cat([torch.eye(3, dtype=torch.float64).expand(40, 3, 3), -skew(POINTS)], -1)
    jacobian = (by_point @ T.rotation[:, None] @ local).flatten(1, 2)
    r = residuals(T).flatten(1)
    return System((r**2).sum(-1), (jacobian.mT @ r[..., None])[..., 0], jacobian.mT @ jacobian)


def starts(count: int, spread: float = 0.2) -> SE3:
    generator = torch.Generator().manual_seed(1)
    return SE3.exp(XI_TRUE + spread * torch.randn((count, 6), generator=generator, dtype=torch.float64))


def test_it_finds_what_scipy_finds() -> None:
    def flat(xi: Tensor) -> Tensor:
        return residuals(SE3.exp(torch.as_tensor(xi, dtype=torch.float64))).flatten().numpy()

    oracle = least_squares(flat, XI_TRUE.numpy(), method="lm", xtol=1e-14, ftol=1e-14, gtol=1e-14)
    found = descend(evaluate, starts(8), 30)
    expected = SE3.exp(torch.as_tensor(oracle.x)).matrix().expand(8, 4, 4)
    torch.testing.assert_close(found.T.matrix(), expected, rtol=0, atol=1e-7)
    torch.testing.assert_close(
        found.system.cost, torch.full((8,), 2 * oracle.cost, dtype=torch.float64), rtol=1e-9, atol=0
    )


def test_the_cost_never_rises_and_what_is_not_better_is_taken_back() -> None:
    """From far away, where full steps overshoot."""
    found = descend(evaluate, starts(32, spread=0.8), 25, damping=1e-6)
    costs = torch.stack([evaluate(found.poses[i]).cost for i in range(26)])
    assert torch.equal(costs, found.costs)
    assert bool((costs.diff(dim=0) <= 0).all())
    refused = ~found.accepted
    assert bool(refused.any())
    moved = (found.poses.matrix().diff(dim=0) != 0).any(-1).any(-1)
    assert torch.equal(moved, found.accepted)


def test_poses_do_not_know_of_each_other() -> None:
    together = descend(evaluate, starts(5, 0.6), 10)
    alone = [descend(evaluate, starts(5, 0.6)[i : i + 1], 10) for i in range(5)]
    torch.testing.assert_close(
        together.T.matrix(), torch.cat([a.T.matrix() for a in alone]), rtol=1e-9, atol=1e-12
    )


def test_no_unit_matters() -> None:
    """With lengths in millimetres the steps are the same (Marquardt's scaling)."""
    scale = torch.tensor([1e3, 1e3, 1e3, 1, 1, 1], dtype=torch.float64)

    def in_millimetres(T: SE3) -> System:
        system = evaluate(T)
        return System(system.cost, system.gradient / scale, system.hessian / scale[:, None] / scale)

    found = descend(evaluate, starts(3), 5)
    other = descend(in_millimetres, starts(3), 5, lambda T, xi: T.retract(xi / scale))
    torch.testing.assert_close(found.T.matrix(), other.T.matrix(), rtol=1e-6, atol=1e-9)


def test_it_stops_where_steps_are_short() -> None:
    found = descend(evaluate, starts(4), 50, stop=1e-6)
    assert len(found.accepted) < 15
    assert bool(found.settled.all())
    longer = descend(evaluate, found.T, 5)
    torch.testing.assert_close(longer.T.matrix(), found.T.matrix(), rtol=0, atol=1e-5)


def test_no_step_is_a_descent_of_its_own() -> None:
    found = descend(evaluate, starts(3), 0)
    assert found.accepted.shape == (0, 3)
    assert not bool(found.settled.any())
    assert torch.equal(found.T.matrix(), starts(3).matrix())


def test_what_the_cost_is_blind_to_stays() -> None:
    """No information on three of the six directions, as where a plain wall is all that is seen."""
    seen = torch.tensor([1.0, 1, 1, 0, 0, 0], dtype=torch.float64)
    full = evaluate(starts(2))
    blind = System(full.cost, full.gradient * seen, full.hessian * seen * seen[:, None])
    step = solve(blind, torch.full((2,), 1e-3, dtype=torch.float64))
    assert torch.equal(step[:, 3:], torch.zeros((2, 3), dtype=torch.float64))
    inner = full.hessian[:, :3, :3]
    expected = -torch.linalg.solve(
        inner + 1e-3 * torch.diag_embed(inner.diagonal(dim1=-2, dim2=-1)), full.gradient[:, :3]
    )
    torch.testing.assert_close(step[:, :3], expected, rtol=1e-5, atol=1e-9)


@pytest.mark.parametrize(
    "spoil",
    [
        lambda s: System(s.cost, 0 * s.gradient, 0 * s.hessian),
        lambda s: System(s.cost, s.gradient, -s.hessian),
        lambda s: System(s.cost, s.gradient * torch.nan, s.hessian),
        lambda s: System(s.cost, s.gradient, s.hessian * torch.inf),
        lambda s: System(s.cost * torch.nan, s.gradient, s.hessian * torch.nan),
    ],
    ids=["nothing seen", "not convex", "NaN gradient", "infinite", "all NaN"],
)
def test_what_cannot_be_solved_takes_no_step_and_harms_no_other(spoil: Callable[[System], System]) -> None:
    def first_spoilt(T: SE3) -> System:
        good, bad = evaluate(T), spoil(evaluate(T))
        parts = zip(
            (bad.cost, bad.gradient, bad.hessian), (good.cost, good.gradient, good.hessian), strict=True
        )
        return System(*(torch.cat([b[:1], g[1:]]) for b, g in parts))

    found = descend(first_spoilt, starts(3), 20)
    assert torch.equal(found.T[0].matrix(), starts(3)[0].matrix())
    torch.testing.assert_close(found.T[1:].matrix(), descend(evaluate, starts(3), 20).T[1:].matrix())
