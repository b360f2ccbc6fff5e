"""How many independent measurements correlated ones count as."""

from __future__ import annotations

import pytest

from bidnerf_core.geometry import independent


@pytest.mark.parametrize("most", [3.0, 100.0])
def test_many_measurements_count_as_the_most_and_one_as_one(most: float) -> None:
    assert independent(1, most) == 1
    assert independent(1e9, most) == pytest.approx(most)
    assert independent(50, 1e9) == pytest.approx(50)
