"""What an image tells of the intrinsics of its camera, and what it leaves open."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.integrate import quad
from scipy.stats import norm

from bidnerf_core.localization.search.miscalibration import (
    MIXTURE,
    unresolved_deviations,
)


def left_open(apparent: float, deviation: float) -> float:
    """The standard deviation of the focal length's correction that is left."""
    values = torch.full((4,), apparent, dtype=torch.float64)
    return float(unresolved_deviations(values, torch.full((4,), deviation**2, dtype=torch.float64))[0])


def by_integration(apparent: float, deviation: float) -> float:
    """The standard deviation about zero of the posterior of the focal length, by quadrature over the prior."""

    def posterior(x: float) -> float:
        prior = sum(share * norm.pdf(x, scale=part.log_focal) for part, share in MIXTURE)
        return float(prior * norm.pdf(apparent, loc=x, scale=deviation))

    places = sorted({0.0, apparent, *(k * deviation + apparent for k in (-3, 3))})
    mass, second = (
        quad(lambda x, n=n: x**n * posterior(x), -0.5, 0.5, points=places, limit=500)[0] for n in (0, 2)
    )
    return float(np.sqrt(second / mass))


@pytest.mark.parametrize("apparent", [0.0, 0.004, 0.02, 0.1])
@pytest.mark.parametrize("deviation", [0.001, 0.01])
def test_what_stays_open_is_the_spread_of_the_posterior(apparent: float, deviation: float) -> None:
    assert left_open(apparent, deviation) == pytest.approx(by_integration(apparent, deviation), rel=1e-3)


def test_an_image_that_tells_nothing_leaves_usual_errors_open() -> None:
    assert sum(share for _, share in MIXTURE) == pytest.approx(1)
    expected = sum(share * part.log_focal**2 for part, share in MIXTURE) ** 0.5
    assert left_open(0.0, 10.0) == pytest.approx(expected, rel=1e-2)


def test_an_exact_image_of_a_calibrated_camera_leaves_little_open() -> None:
    assert left_open(0.0, 1e-4) < 2e-4
