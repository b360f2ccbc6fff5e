"""Normal equations, a Gaussian prior as such, and Levenberg-Marquardt, which finds what scipy finds and takes no step that it cannot solve for."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from jaxtyping import Float
from scipy.optimize import least_squares
from torch import Generator, Tensor

from bidnerf_core.geometry import SE3, skew
from bidnerf_core.localization import Cost, GaussianPrior, NormalEquations, Pivot, Scaled, Sum, descend


def random(count: int, generator: Generator) -> NormalEquations:
    """Return well-conditioned equations."""
    rows = torch.randn((count, 20, 6), generator=generator, dtype=torch.float64)
    gradient = torch.randn((count, 6), generator=generator, dtype=torch.float64)
    return NormalEquations(torch.arange(count, dtype=torch.float64), gradient, rows.mT @ rows)


@pytest.mark.parametrize("damping", [0.0, 1e-3, 10.0])
def test_the_step_solves_the_damped_equations(damping: float, generator: Generator) -> None:
    equations = random(4, generator)
    step = equations.solve(torch.full((4,), damping, dtype=torch.float64))
    damped = equations.hessian + damping * torch.diag_embed(equations.hessian.diagonal(dim1=-2, dim2=-1))
    expected = -torch.linalg.solve(damped, equations.gradient)
    torch.testing.assert_close(step, expected, rtol=1e-6, atol=1e-9)


def test_there_is_no_step_along_what_the_cost_is_blind_to(generator: Generator) -> None:
    """No information on three of the six directions, as where a plain wall is all that is seen."""
    seen = torch.tensor([1.0, 1, 1, 0, 0, 0], dtype=torch.float64)
    full = random(2, generator)
    blind = NormalEquations(full.cost, full.gradient * seen, full.hessian * seen * seen[:, None])
    step = blind.solve(torch.full((2,), 1e-3, dtype=torch.float64))
    assert torch.equal(step[:, 3:], torch.zeros((2, 3), dtype=torch.float64))
    inner = full.hessian[:, :3, :3]
    expected = -torch.linalg.solve(
        inner + 1e-3 * torch.diag_embed(inner.diagonal(dim1=-2, dim2=-1)), full.gradient[:, :3]
    )
    torch.testing.assert_close(step[:, :3], expected, rtol=1e-5, atol=1e-9)


def test_equations_that_cannot_be_solved_have_no_step_and_harm_no_other(generator: Generator) -> None:
    good = random(5, generator)
    hessian, gradient = good.hessian.clone(), good.gradient.clone()
    hessian[0] = -hessian[0]
    hessian[1] = torch.inf
    gradient[2] = torch.nan
    hessian[3] = torch.nan
    none = torch.zeros(5, dtype=torch.float64)
    step = NormalEquations(good.cost, gradient, hessian).solve(none)
    assert not bool(step[:4].any())
    assert torch.equal(step[4], good.solve(none)[4])


def test_a_sum_of_costs_is_a_cost(generator: Generator) -> None:
    parts = [random(3, generator) for _ in range(3)]
    whole = Sum((lambda T: parts[0], lambda T: parts[1], lambda T: parts[2]))
    assert isinstance(whole, Cost)
    found = whole(SE3.identity()[None])
    for name in ("cost", "gradient", "hessian"):
        expected = sum(getattr(part, name) for part in parts)
        torch.testing.assert_close(getattr(found, name), expected, rtol=0, atol=0)
    assert Sum((lambda T: parts[0],))(SE3.identity()[None]) is parts[0]


@pytest.mark.parametrize("factor", [0.25, 1.0, 1000.0])
def test_a_scaled_cost_takes_the_same_steps_and_weighs_more_in_a_sum(
    factor: float, generator: Generator
) -> None:
    parts, here = random(3, generator), SE3.identity()[None]
    scaled = Scaled(lambda T: parts, factor)
    assert isinstance(scaled, Cost)
    found, damping = scaled(here), torch.full((3,), 1e-3, dtype=torch.float64)
    for name in ("cost", "gradient", "hessian"):
        torch.testing.assert_close(getattr(found, name), factor * getattr(parts, name))
    torch.testing.assert_close(found.solve(damping), parts.solve(damping), rtol=1e-6, atol=1e-9)
    torch.testing.assert_close(Sum((scaled, lambda T: parts))(here).cost, (factor + 1) * parts.cost)


def test_equations_are_chosen_pose_by_pose(generator: Generator) -> None:
    one, other = random(3, generator), random(3, generator)
    found = one.chosen(torch.tensor([True, False, True]), other)
    for name in ("cost", "gradient", "hessian"):
        values = getattr(found, name)
        assert torch.equal(values[[0, 2]], getattr(one, name)[[0, 2]])
        assert torch.equal(values[1], getattr(other, name)[1])


def wide(generator: Generator) -> NormalEquations:
    """Return two sets of well-conditioned equations of seven unknowns."""
    rows = torch.randn((2, 20, 7), generator=generator, dtype=torch.float64)
    gradient = torch.randn((2, 7), generator=generator, dtype=torch.float64)
    return NormalEquations(torch.tensor([3.0, 5.0], dtype=torch.float64), gradient, rows.mT @ rows)


def model(equations: NormalEquations, unknowns: torch.Tensor) -> torch.Tensor:
    linear = 2 * (equations.gradient * unknowns).sum(-1)
    return equations.cost + linear + torch.einsum("hi,hij,hj->h", unknowns, equations.hessian, unknowns)


def test_equations_of_other_unknowns_have_the_value_of_what_they_map_to(generator: Generator) -> None:
    whole = wide(generator)
    updates = torch.randn((7, 3), generator=generator, dtype=torch.float64)
    others = torch.randn((2, 3), generator=generator, dtype=torch.float64)
    torch.testing.assert_close(model(whole.of_others(updates), others), model(whole, others @ updates.mT))


MEAN = SE3.exp(torch.tensor([0.4, -1.0, 2.0, 0.8, -0.5, 0.3], dtype=torch.float64))
PIVOTS = {
    "camera": Pivot(SE3.identity()),
    "scene": Pivot.at_point(torch.tensor([0.2, -0.1, 1.5])),
    "world": Pivot(None),
}
OFFSETS = [0.0, 1e-3, 0.3, 2.0]
"""Lengths of the tangent vectors from the mean: at it, where the Jacobian is a series, near and far."""


@pytest.fixture
def covariance(generator: Generator) -> Tensor:
    """Correlated, and of unequal scales."""
    root = torch.randn((6, 6), generator=generator, dtype=torch.float64)
    scale = torch.tensor([0.1, 0.02, 0.05, 0.01, 0.03, 0.02], dtype=torch.float64)
    return scale[:, None] * (root @ root.mT + 0.1 * torch.eye(6)) * scale


def away(length: float, generator: Generator) -> SE3:
    """Return two poses off the mean."""
    xi = torch.randn((2, 6), generator=generator, dtype=torch.float64)
    return MEAN.retract(length * xi / xi.norm(dim=-1, keepdim=True))


@pytest.mark.parametrize("pivot", PIVOTS)
def test_at_the_mean_there_is_no_cost_and_no_slope(pivot: str, covariance: Tensor) -> None:
    prior = GaussianPrior(MEAN, covariance, PIVOTS[pivot])
    assert isinstance(prior, Cost)
    found = prior(MEAN[None])
    assert float(found.cost) < 1e-20
    assert float(found.gradient.abs().max()) < 1e-9


def test_the_cost_is_the_squared_mahalanobis_distance(covariance: Tensor) -> None:
    """One standard deviation along each principal axis costs 1."""
    values, axes = torch.linalg.eigh(covariance)
    poses = MEAN.retract((axes * values.sqrt()).mT)
    found = GaussianPrior(MEAN, covariance, PIVOTS["scene"])(poses)
    torch.testing.assert_close(found.cost, torch.ones(6, dtype=torch.float64), rtol=1e-8, atol=0)


@pytest.mark.parametrize("length", OFFSETS)
@pytest.mark.parametrize("pivot", PIVOTS)
def test_derivatives_are_those_by_differences(
    pivot: str, length: float, covariance: Tensor, generator: Generator
) -> None:
    """The cost is a square ``r.r``: its gradient is half its slope, and its Hessian is that of Gauss and Newton."""
    prior, T, step = GaussianPrior(MEAN, covariance, PIVOTS[pivot]), away(length, generator), 1e-6
    whiten = torch.linalg.cholesky(torch.linalg.inv(covariance)).mT
    slopes, columns = [], []
    for unit in torch.eye(6, dtype=torch.float64):
        above, below = (prior.pivot.moved(T, (sign * step * unit).expand(2, 6)) for sign in (1, -1))
        slopes.append((prior(above).cost - prior(below).cost) / (2 * step))
        change = (MEAN[None].inverse() @ above).log() - (MEAN[None].inverse() @ below).log()
        columns.append(change @ whiten.mT / (2 * step))
    jacobian = torch.stack(columns, dim=-1)
    found = prior(T)
    scale = float(jacobian.abs().max()) ** 2
    torch.testing.assert_close(found.hessian, jacobian.mT @ jacobian, rtol=1e-6, atol=1e-7 * scale)
    torch.testing.assert_close(found.gradient, torch.stack(slopes, -1) / 2, rtol=1e-6, atol=1e-7 * scale)


@pytest.mark.parametrize("pivot", PIVOTS)
def test_the_hessian_at_the_mean_gives_the_covariance_back(pivot: str, covariance: Tensor) -> None:
    chosen = PIVOTS[pivot]
    hessian = GaussianPrior(MEAN, covariance, chosen)(MEAN[None]).hessian[0]
    found = chosen.at_camera(MEAN, torch.linalg.inv(hessian))
    torch.testing.assert_close(found, covariance, rtol=1e-8, atol=1e-14)


def test_two_priors_meet_where_their_information_says(generator: Generator) -> None:
    """A Kalman update: close by, the sum of two priors is least at the mean weighted by information."""
    first, second = (torch.diag(torch.rand(6, generator=generator, dtype=torch.float64) + 0.5) for _ in "ab")
    xi = 1e-4 * torch.randn(6, generator=generator, dtype=torch.float64)
    about = PIVOTS["camera"]
    other = MEAN.retract(xi)
    weight = 3.0
    cost = Sum((GaussianPrior(MEAN, first, about), Scaled(GaussianPrior(other, second, about), weight)))
    found = descend(cost, MEAN[None], 10, about.moved).T[0]
    information = torch.linalg.inv(first) + weight * torch.linalg.inv(second)
    expected = torch.linalg.solve(information, weight * torch.linalg.solve(second, xi))
    torch.testing.assert_close((MEAN.inverse() @ found).log(), expected, rtol=1e-3, atol=1e-8)


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
