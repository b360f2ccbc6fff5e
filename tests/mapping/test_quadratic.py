"""Quadratic models of costs: their minimum under any prior, and the evidence of each explanation."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.stats import multivariate_normal
from torch import Tensor

from bidnerf import SE3
from bidnerf_core.mapping import NUISANCES, CostTerm, Normal, Quadratic, States, descend, log_det, log_evidence, total

P = 6 + len(NUISANCES)


def random(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def states(h: int, deviation: float = 0.1, seed: int = 0) -> States:
    """Return states near the identity, with all nuisances free, at their means."""
    zero, number = torch.zeros(h, dtype=torch.float64), torch.arange(h)
    z = torch.zeros((h, P - 6), dtype=torch.float64)
    T = SE3.exp(0.01 * random(h, 6, seed=seed))
    return States(T, z, z, z + deviation, zero, zero + 1, 0 * number, number)


def linear(rows: int = 60, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Return a linear model (r P) of observations (r) with unit noise."""
    return random(rows, P, seed=seed), random(rows, seed=seed + 1)


def unknowns(at: States) -> Tensor:
    """Return the coordinates of a pose near the identity, and the nuisances (h P)."""
    return torch.cat([at.T.log(), at.nuisances], -1)


def least_squares(A: Tensor, b: Tensor) -> CostTerm:
    """Return half of the squared norm of ``A x - b``, with x linearized about each state."""

    def term(at: States) -> Normal:
        unit = torch.cat([torch.ones(len(at), 6).double(), at.deviation], -1)
        residual = unknowns(at) @ A.mT - b
        rows = A * unit[:, None]
        gradient = (rows.mT @ residual[..., None])[..., 0]
        return Normal(0.5 * residual.square().sum(-1), gradient, rows.mT @ rows)

    return term


def test_a_quadratic_is_minimized() -> None:
    A, b = linear()
    at, term = states(3), least_squares(*linear())
    _, normal = descend(at, [term], 12)
    precision = torch.diag(torch.cat([torch.zeros(6), torch.full((P - 6,), 100.0)])).double()
    expected = torch.linalg.solve(A.mT @ A + precision, A.mT @ b)
    small = replace(at, T=SE3.exp(expected[:6].expand(3, 6)))
    least = total(replace(small, z=(expected[6:] / 0.1).expand(3, -1)), [term]).cost
    assert bool((normal.cost >= least - 1e-9).all())
    assert bool((normal.cost <= least + 0.01).all())  # what counts as settled


def test_a_direction_without_information_is_not_moved_along() -> None:
    A, b = linear()
    A[:, 2] = 0
    start = states(2)
    found, _ = descend(start, [least_squares(A, b)], 10)
    assert bool(found.T.matrix().isfinite().all())
    moved = (start.T.inverse() @ found.T).log()
    assert float(moved[:, 2].abs().max()) < 0.2 * float(moved[:, :2].abs().max())


def model(seed: int = 0, factor: float = 1.0) -> tuple[Tensor, Tensor, Quadratic]:
    """Return a linear model, and the quadratic one of its cost about the origin."""
    A, b = linear(seed=seed)
    A = factor * A
    here = replace(states(1, 0.3), T=SE3.exp(torch.zeros((1, 6), dtype=torch.float64)))
    return A, b, Quadratic.of(least_squares(A, b)(here), here)


PRIORS = {
    "wide": (0.0, torch.full((P - 6,), 10.0)),
    "narrow": (0.05, torch.full((P - 6,), 0.02)),
    "some fixed": (0.03, torch.tensor([0.1, 0.0, 0.0, 0.3, 0.0, 0.0] + [0.0] * 6 + [0.2])),
    "all fixed": (0.02, torch.zeros(P - 6)),
}


@pytest.mark.parametrize("name", PRIORS)
def test_the_minimum_under_any_prior_is_that_of_a_direct_solution(name: str) -> None:
    A, b, quadratic = model(factor=30)  # so that the pose stays where updates are nearly linear
    here = quadratic.here
    mean, deviation = PRIORS[name][0] * random(P - 6, seed=8), PRIORS[name][1].double()
    found, _ = quadratic.minimum(here.under(mean, deviation))
    free = torch.cat([torch.ones(6, dtype=torch.bool), deviation > 0])
    precision = torch.diag(torch.cat([torch.zeros(6).double(), deviation.clamp(min=1e-9) ** -2])[free])
    target = b - A[:, ~free] @ mean[~free[6:]]
    right = A[:, free].mT @ target
    right[6:] += mean[free[6:]] * deviation[free[6:]] ** -2
    expected = torch.linalg.solve(A[:, free].mT @ A[:, free] + precision, right)
    torch.testing.assert_close(unknowns(found)[0][free], expected, rtol=1e-3, atol=1e-5)
    assert torch.equal(found.nuisances[0, ~free[6:]], mean[~free[6:]])


def test_the_evidence_of_a_gaussian_model_is_the_marginal_density_of_its_observations() -> None:
    """The pose has a flat prior: its density is that of a very wide one, which is the same for all explanations."""
    A, b, quadratic = model()
    found, expected = [], []
    width = 1e3
    for size, wide in PRIORS.values():
        mean, deviation = size * random(P - 6, seed=8), wide.double()
        at = replace(quadratic.here, log_prior=quadratic.here.log_prior - 1.5)
        found.append(float(log_evidence(*quadratic.minimum(at.under(mean, deviation)))[0]))
        spread = torch.cat([torch.full((6,), width), deviation]).double()
        covariance = torch.eye(len(b)).double() + A * spread.square() @ A.mT
        density = multivariate_normal((A[:, 6:] @ mean).numpy(), covariance.numpy())
        expected.append(density.logpdf(b.numpy()) - 1.5)
    shift = -3 * math.log(2 * math.pi) - 6 * math.log(width)  # of the pose's wide prior
    shift += 3 * math.log(2 * math.pi) - len(b) / 2 * math.log(2 * math.pi)
    np.testing.assert_allclose(np.array(expected) - np.array(found), shift, atol=0.02)


def test_the_sum_of_models_about_a_mode_is_the_model_of_the_sum() -> None:
    (A, b, one), (C, d, other) = model(), model(seed=5)
    joined = one.with_rows_added(torch.tensor([0]), other)
    both = least_squares(torch.cat([A, C]), torch.cat([b, d]))
    here = Quadratic.of(both(one.here), one.here)
    for name in ("cost", "gradient", "hessian"):
        torch.testing.assert_close(getattr(joined, name), getattr(here, name))


def test_the_determinant_of_what_is_not_positive_is_infinite() -> None:
    good = random(4, 4)
    good = good @ good.mT
    bad = good - 2 * good.diagonal().max() * torch.eye(4)
    found = log_det(torch.stack([good, bad, torch.full_like(good, math.nan)]))
    assert found[0] == pytest.approx(float(torch.linalg.slogdet(good).logabsdet))
    assert found[1:].tolist() == [math.inf, math.inf]
