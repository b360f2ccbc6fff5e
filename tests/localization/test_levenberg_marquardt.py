"""Levenberg-Marquardt for many poses: it finds what scipy finds, never goes uphill, and takes no step it cannot solve for."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from jaxtyping import Float
from scipy.optimize import least_squares
from torch import Tensor

from bidnerf_core.geometry import SE3, skew
from bidnerf_core.localization import NormalEquations, Sum, descend

GENERATOR = torch.Generator().manual_seed(0)
POINTS = torch.randn((40, 3), generator=GENERATOR, dtype=torch.float64) + torch.tensor([0.0, 0, 4])
XI_TRUE = torch.tensor([0.3, -0.2, 0.5, 0.2, 0.4, -0.3], dtype=torch.float64)
NOISE = 0.01 * torch.randn((40, 2), generator=GENERATOR, dtype=torch.float64)


def projected(points: Float[Tensor, "*h n 3"]) -> Float[Tensor, "*h n 2"]:
    return points[..., :2] / points[..., 2:]


SEEN = projected(SE3.exp(XI_TRUE).apply(POINTS)) + NOISE


def residuals(T: SE3) -> Float[Tensor, "*h n 2"]:
    """Return errors of reprojection: T takes POINTS to a camera that saw them at SEEN."""
    points = T.rotation[..., None, :, :] @ POINTS[..., None]
    return projected(points[..., 0] + T.translation[..., None, :]) - SEEN


def rows(T: SE3) -> tuple[Float[Tensor, "h n 2"], Float[Tensor, "h n 2 6"]]:
    """Return the residuals and their analytic Jacobian by right updates."""
    points = (T.rotation[:, None] @ POINTS[..., None])[..., 0] + T.translation[:, None]
    x, y, z = points.unbind(-1)
    zero = torch.zeros_like(x)
    by_point = torch.stack(
        [torch.stack([1 / z, zero, -x / z**2], -1), torch.stack([zero, 1 / z, -y / z**2], -1)], -2
    )
    local = torch.cat([torch.eye(3, dtype=torch.float64).expand(40, 3, 3), -skew(POINTS)], -1)
    return residuals(T), by_point @ T.rotation[:, None] @ local


def evaluate(T: SE3) -> NormalEquations:
    """Return the sum of squares and its Gauss-Newton model."""
    r, jacobian = rows(T)
    r, jacobian = r.flatten(1), jacobian.flatten(1, 2)
    return NormalEquations((r**2).sum(-1), (jacobian.mT @ r[..., None])[..., 0], jacobian.mT @ jacobian)


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
        found.equations.cost, torch.full((8,), 2 * oracle.cost, dtype=torch.float64), rtol=1e-9, atol=0
    )


def test_the_cost_never_rises_and_what_is_not_better_is_taken_back() -> None:
    """The descent begins far away, where full steps overshoot."""
    found = descend(evaluate, starts(32, spread=0.8), 25, damping=1e-6)
    costs = torch.stack([evaluate(found.poses[i]).cost for i in range(26)])
    assert torch.equal(costs, found.costs)
    assert bool((costs.diff(dim=0) <= 0).all())
    refused = ~found.accepted
    assert bool(refused.any())
    moved = (found.poses.matrix().diff(dim=0) != 0).any(-1).any(-1)
    assert torch.equal(moved, found.accepted)


def test_poses_are_independent_of_each_other() -> None:
    together = descend(evaluate, starts(5, 0.6), 10)
    alone = [descend(evaluate, starts(5, 0.6)[i : i + 1], 10) for i in range(5)]
    torch.testing.assert_close(
        together.T.matrix(), torch.cat([a.T.matrix() for a in alone]), rtol=1e-9, atol=1e-12
    )


def test_no_unit_matters() -> None:
    """Steps are the same with lengths in millimetres (Marquardt's scaling)."""
    scale = torch.tensor([1e3, 1e3, 1e3, 1, 1, 1], dtype=torch.float64)

    def in_millimetres(T: SE3) -> NormalEquations:
        found = evaluate(T)
        return NormalEquations(found.cost, found.gradient / scale, found.hessian / scale[:, None] / scale)

    found = descend(evaluate, starts(3), 5)
    other = descend(in_millimetres, starts(3), 5, lambda T, xi: T.retract(xi / scale))
    torch.testing.assert_close(found.T.matrix(), other.T.matrix(), rtol=1e-6, atol=1e-9)


def test_it_stops_where_steps_are_short() -> None:
    found = descend(evaluate, starts(4), 50, stop=1e-6)
    assert len(found.accepted) < 15
    assert bool(found.converged.all())
    longer = descend(evaluate, found.T, 5)
    torch.testing.assert_close(longer.T.matrix(), found.T.matrix(), rtol=0, atol=1e-5)


def test_no_step_is_a_descent_of_its_own() -> None:
    found = descend(evaluate, starts(3), 0)
    assert found.accepted.shape == (0, 3)
    assert not bool(found.converged.any())
    assert torch.equal(found.T.matrix(), starts(3).matrix())


@pytest.mark.parametrize(
    "spoil",
    [
        lambda s: NormalEquations(s.cost, 0 * s.gradient, 0 * s.hessian),
        lambda s: NormalEquations(s.cost, s.gradient, -s.hessian),
        lambda s: NormalEquations(s.cost, s.gradient * torch.nan, s.hessian),
        lambda s: NormalEquations(s.cost, s.gradient, s.hessian * torch.inf),
        lambda s: NormalEquations(s.cost * torch.nan, s.gradient, s.hessian * torch.nan),
    ],
    ids=["nothing seen", "not convex", "NaN gradient", "infinite", "all NaN"],
)
def test_what_cannot_be_solved_takes_no_step_and_harms_no_other(
    spoil: Callable[[NormalEquations], NormalEquations],
) -> None:
    def first_spoilt(T: SE3) -> NormalEquations:
        good, bad = evaluate(T), spoil(evaluate(T))
        parts = zip(
            (bad.cost, bad.gradient, bad.hessian), (good.cost, good.gradient, good.hessian), strict=True
        )
        return NormalEquations(*(torch.cat([b[:1], g[1:]]) for b, g in parts))

    found = descend(first_spoilt, starts(3), 20)
    assert torch.equal(found.T[0].matrix(), starts(3)[0].matrix())
    torch.testing.assert_close(found.T[1:].matrix(), descend(evaluate, starts(3), 20).T[1:].matrix())


def test_two_costs_are_descended_as_one() -> None:
    """Half of the points in each of two costs, which a sum joins, lead where all of them in one do."""

    def part(chosen: slice) -> Callable[[SE3], NormalEquations]:
        def cost(T: SE3) -> NormalEquations:
            r, jacobian = rows(T)
            r, jacobian = r[:, chosen].flatten(1), jacobian[:, chosen].flatten(1, 2)
            return NormalEquations(
                (r**2).sum(-1), (jacobian.mT @ r[..., None])[..., 0], jacobian.mT @ jacobian
            )

        return cost

    both = Sum((part(slice(0, 25)), part(slice(25, 40))))
    one, whole = both(starts(3)), evaluate(starts(3))
    for name in ("cost", "gradient", "hessian"):
        torch.testing.assert_close(getattr(one, name), getattr(whole, name))
    found = descend(both, starts(3), 20)
    torch.testing.assert_close(found.T.matrix(), descend(evaluate, starts(3), 20).T.matrix())
