"""The trial of a field and a surface on a map's own images: how many independent measurements these count as."""

from __future__ import annotations

import pytest
import torch

from bidnerf_core.captures.field_trial import tried
from bidnerf_core.fields.contract import RadianceField
from bidnerf_core.geometry.independent import USUAL, Independent, independent
from bidnerf_core.geometry.se3 import SE3
from bidnerf_core.testing.textured_field import BOUNDS, MovedField, ground, training_views

VIEWS = training_views()[:6]


def off(metres: float) -> RadianceField:
    """Return a field that stands beside where the images show it."""
    return MovedField(ground(), SE3.exp(torch.tensor([metres, 0, 0, 0, 0, 0], dtype=torch.float64)))


def test_the_farther_a_field_is_off_the_less_its_rays_count() -> None:
    counts = [tried(off(metres), BOUNDS, VIEWS).rays for metres in (0.03, 0.01, 0.0)]
    assert counts == sorted(counts)
    assert counts[0] < 0.1 * counts[-1]


def test_too_few_images_leave_the_table_as_it_is() -> None:
    assert tried(ground(), BOUNDS, VIEWS[:3]) == USUAL == Independent()


@pytest.mark.parametrize("most", [3.0, 100.0])
def test_many_measurements_count_as_the_most_and_one_as_one(most: float) -> None:
    assert independent(1, most) == 1
    assert independent(1e9, most) == pytest.approx(most)
    assert independent(50, 1e9) == pytest.approx(50)
