"""The trial of a map: how many measurements count as one, from errors, and what small images compare."""

from __future__ import annotations

import pytest
import torch

# Inside: the fit of errors is tested without the localizations that they come from
from bidnerf_core.captures.trial import (
    CORRELATION,
    ERROR_FREEDOM,
    EXCESS,
    TAILS,
    _most_probable,
    _student,
    factor_of_tails,
    held_out_images,
)
from bidnerf_core.geometry import chi_squared_quantile


@pytest.mark.parametrize("factor", [0.3, 1.0, 5.0, 40.0])
def test_the_factor_of_a_covariance_is_found_from_many_errors(factor: float, generator: torch.Generator) -> None:
    root = torch.randn(6, 6, generator=generator, dtype=torch.float64)
    covariance = root @ root.mT
    drawn = torch.randn(200, 6, generator=generator, dtype=torch.float64)
    errors = factor**0.5 * drawn @ torch.linalg.cholesky(covariance).mT
    found = _most_probable(CORRELATION, lambda c: _student(errors, c * covariance.expand(200, 6, 6)))
    assert found == pytest.approx(factor, rel=0.15)


def test_few_errors_leave_the_prior_and_one_wrong_pose_in_ten_changes_little(generator: torch.Generator) -> None:
    eye = torch.eye(6, dtype=torch.float64)
    assert _most_probable(EXCESS, lambda factor: 0.0) == pytest.approx(EXCESS[0])
    errors = torch.randn(20, 6, generator=generator, dtype=torch.float64)
    errors[:2] *= 30
    assert _most_probable(EXCESS, lambda factor: _student(errors, factor * eye.expand(20, 6, 6))) < 12


@pytest.mark.parametrize("scale", [0.3, 1.0, 2.0])
def test_the_covariance_holds_95_percent_of_heavy_tailed_errors(scale: float, generator: torch.Generator) -> None:
    root = torch.randn(6, 6, generator=generator, dtype=torch.float64)
    covariance = (root @ root.mT).expand(2000, 6, 6)
    drawn = torch.randn(2000, 6 + int(ERROR_FREEDOM), generator=generator, dtype=torch.float64)
    tails = (ERROR_FREEDOM / drawn[:, 6:].square().sum(1)).sqrt()  # of a Student-t distribution
    errors = scale**0.5 * tails[:, None] * drawn[:, :6] @ root.mT
    factor = factor_of_tails(errors, covariance)
    squared = (errors[:, None] @ torch.linalg.solve(factor * covariance, errors[..., None])).flatten()
    assert float((squared <= chi_squared_quantile(0.95, 6)).double().mean()) == pytest.approx(0.95, abs=0.01)
    none = torch.zeros((0, 6), dtype=torch.float64), torch.zeros((0, 6, 6), dtype=torch.float64)
    assert factor_of_tails(*none) == pytest.approx(TAILS[0])


@pytest.mark.parametrize(("count", "expected"), [(2, 0), (9, 3), (24, 8), (100, 12), (400, 24)])
def test_the_images_held_out_are_spread_evenly(count: int, expected: int) -> None:
    numbers = held_out_images(count)
    assert len(numbers) == len(set(numbers)) == expected
    assert all(0 <= number < count for number in numbers)
