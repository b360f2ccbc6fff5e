"""A Gaussian prior of a pose as a cost: zero at its mean, exact derivatives about every pivot, its covariance in its Hessian."""

from __future__ import annotations

import pytest
import torch
from torch import Generator, Tensor

from bidnerf_core.geometry import SE3
from bidnerf_core.localization import Cost, GaussianPrior, Pivot, Scaled, Sum, descend

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


def test_a_solver_finds_the_mean_from_afar(covariance: Tensor, generator: Generator) -> None:
    prior = GaussianPrior(MEAN, covariance, PIVOTS["scene"])
    found = descend(prior, away(1.0, generator), 20, prior.pivot.moved).T
    torch.testing.assert_close(found.matrix(), MEAN.matrix().expand(2, 4, 4), rtol=0, atol=1e-6)


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
