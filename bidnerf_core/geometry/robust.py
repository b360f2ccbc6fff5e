"""Robust losses, and their weights for iteratively reweighted least squares.

All but ``l1`` equal ``r^2 / 2`` for residuals that are small relative to their scale, so one may replace
another without a change of weights; ``l1`` has the slope of ``huber`` at large residuals. Names and shapes
follow Barron 2019, "A general and adaptive robust loss function" (eqs. 7, 13 to 16), but losses are multiplied
by the squared scale.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, TypeVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.errors import InputError

Values = TypeVar("Values", Tensor, np.ndarray)
RobustName = Literal["huber", "l2", "l1", "cauchy", "geman-mcclure"]

MAD_TO_SIGMA = 1.4826
"""Ratio of the standard deviation to the median absolute deviation of a Gaussian."""
LOSSES: dict[RobustName, Callable[[Tensor, float], Tensor]] = {
    # up to c quadratic, then linear with the slope c
    "huber": lambda r, c: torch.where(r.abs() <= c, 0.5 * r.abs() ** 2, c * (r.abs() - 0.5 * c)),
    "l2": lambda r, c: 0.5 * r**2,
    "l1": lambda r, c: c * r.abs(),  # its derivative at 0 is taken as 0
    "cauchy": lambda r, c: c**2 * torch.log1p(0.5 * (r / c) ** 2),  # the influence of large residuals decreases
    # bounded by 2 c^2: large residuals have almost no influence
    "geman-mcclure": lambda r, c: 2 * c**2 * (r / c) ** 2 / ((r / c) ** 2 + 4),
}
"""``rho(r)`` of each loss at a scale c."""
WEIGHTS: dict[RobustName, Callable[[Tensor, float], Tensor]] = {
    "huber": lambda r, c: c / r.abs().clamp(min=c),
    "l2": lambda r, c: torch.ones_like(r),
    "l1": lambda r, c: c / r.abs().clamp(min=1e-6 * c),
    "cauchy": lambda r, c: inlier_weight(r**2, math.sqrt(2) * c),
    "geman-mcclure": lambda r, c: inlier_weight(r**2, 2 * c) ** 2,
}
"""``rho'(r) / r`` of each loss; that of ``l1``, which is unbounded at 0, is limited there."""


def inlier_weight(squared: Values, half: Values | float) -> Values:
    """Return ``1 / (1 + s / half^2)`` of squared residuals s: 1 at 0, and 1/2 where the residual is ``half``.

    This is the weight of ``cauchy_loss``. It is also the degree to which a residual is an inlier (Geman and
    McClure 1985): the loss of Geman and McClure is one minus this value, and its least-squares weight is the
    square of this value.
    """
    return 1 / (1 + squared / half**2)


def cauchy_loss(squared: np.ndarray, half: float) -> float:
    """Return the sum of Cauchy's loss ``half^2 / 2 log(1 + s / half^2)`` over squared residuals s; see
    ``inlier_weight``.

    Unlike ``cauchy`` in ``LOSSES``, this function takes squared lengths of vectors, and its scale is the
    residual at which the weight is one half.
    """
    return 0.5 * half**2 * float(np.log1p(squared / half**2).sum())


def mad_deviation(values: Tensor | np.ndarray) -> float:
    """Return a robust standard deviation about zero: the median absolute value, scaled as for a Gaussian."""
    sizes = np.abs(np.asarray(values)).ravel()
    half, odd = divmod(len(sizes), 2)
    # ``np.median`` without its checks, which take longer than the rest
    ordered = np.partition(sizes, (half - 1 + odd, half))
    return MAD_TO_SIGMA * float(ordered[half] if odd else 0.5 * (ordered[half - 1] + ordered[half]))


@dataclass(frozen=True)
class Robust:
    """A robust loss with its scale, in the unit of the residuals."""

    name: RobustName
    scale: float

    def __post_init__(self) -> None:
        if not (math.isfinite(self.scale) and self.scale > 0):
            raise InputError(f"the scale of the robust loss is {self.scale}", expected="a positive number")

    def __call__(self, residual: Float[Tensor, "*p"]) -> Float[Tensor, "*p"]:
        return LOSSES[self.name](residual, self.scale)

    def weight(self, residual: Float[Tensor, "*p"]) -> Float[Tensor, "*p"]:
        """Return ``rho'(r) / r``, the weight of iteratively reweighted least squares (Holland and Welsch 1977)."""
        return WEIGHTS[self.name](residual, self.scale)


def chi_squared_quantile(probability: float, count: int) -> float:
    """Return the quantile at ``probability`` of the chi-squared distribution with ``count`` degrees of freedom."""
    from scipy.special import (
        gammaincinv,  # scipy.stats has the same function, but takes a tenth of the total import time
    )

    return 2.0 * float(gammaincinv(count / 2, probability))


KEYPOINTS_PER_INDEPENDENT = 10.0
"""Number of keypoints that count as one independent measurement if a map does not store a number of its own."""
CORNERS_PER_INDEPENDENT = 4.0
"""Number of corners tracked between frames that count as one independent measurement."""
