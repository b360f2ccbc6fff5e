"""Robust losses: their derivatives, their shapes, and what they must have in common."""

from __future__ import annotations

import math
from typing import get_args

import pytest
import torch

from bidnerf_core.geometry import Robust, RobustName
from refusals import refused

NAMES = get_args(RobustName)
SCALE = 0.3


@pytest.mark.parametrize("name", NAMES)
def test_laws_of_a_loss(name: RobustName) -> None:
    """Even, 0 and flat at 0, growing from there, differentiable; weighted squares pull as the loss does."""
    rho = Robust(name, SCALE)
    residual = torch.linspace(0, 5, 200, dtype=torch.float64, requires_grad=True)
    values = rho(residual)
    torch.testing.assert_close(rho(-residual), values)
    assert float(values[0].detach()) == 0
    assert bool((values.diff() > 0).all())
    (slope,) = torch.autograd.grad(values.sum(), residual)
    assert float(slope[0]) == 0
    torch.testing.assert_close(rho.weight(residual) * residual, slope)
    sizes = torch.tensor([0.01, 0.1, 0.29, 0.31, 1.0, 30.0], dtype=torch.float64)
    both = torch.cat([-sizes, sizes]).requires_grad_()
    assert torch.autograd.gradcheck(lambda r: rho(r).sum(), both, eps=1e-6, atol=1e-8)


@pytest.mark.parametrize("name", [name for name in NAMES if name != "l1"])
def test_small_residuals_count_alike(name: RobustName) -> None:
    small = torch.linspace(-1e-3, 1e-3, 11, dtype=torch.float64)
    torch.testing.assert_close(Robust(name, SCALE)(small), small**2 / 2, rtol=1e-4, atol=0)


@pytest.mark.parametrize(("name", "alpha"), [("l2", 2.0), ("cauchy", 0.0), ("geman-mcclure", -2.0)])
def test_barrons_general_form(name: RobustName, alpha: float) -> None:
    """Eq. 7 of Barron 2019 near the alpha that each has a name for, times the squared scale."""
    a = alpha + 1e-6
    residual = torch.linspace(-2, 2, 31, dtype=torch.float64)
    general = abs(a - 2) / a * (((residual / SCALE) ** 2 / abs(a - 2) + 1) ** (a / 2) - 1)
    torch.testing.assert_close(Robust(name, SCALE)(residual), SCALE**2 * general, rtol=1e-4, atol=1e-9)


@pytest.mark.parametrize("scale", [0.0, -1.0, math.nan, math.inf])
def test_a_scale_that_is_not_positive_is_refused(scale: float) -> None:
    with refused(found=f"is {scale}", expected="a positive number"):
        Robust("huber", scale)


def test_far_residuals_pull_less_and_less() -> None:
    """The order of the influence of an outlier is what the losses are chosen by."""
    pull = {}
    for name in NAMES:
        far = torch.tensor([20 * SCALE], dtype=torch.float64, requires_grad=True)
        (slope,) = torch.autograd.grad(Robust(name, SCALE)(far).sum(), far)
        pull[name] = float(slope)
    assert pull["l1"] == pytest.approx(pull["huber"])
    assert pull["l2"] > pull["l1"] > pull["cauchy"] > pull["geman-mcclure"] > 0
