"""Fields in closed form: they keep the contract, and volume rendering finds what is known of them."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from balls import HomogeneousBall
from bidnerf.scenes import GaussianBlobs
from bidnerf.testing import (
    check_background,
    check_intervals,
    check_levels,
    check_precision,
    check_ranges,
    check_rays_alone,
    check_repeatable,
    check_shapes,
)
from bidnerf_core.fields import RadianceField, SceneBounds

BOUNDS = SceneBounds((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0), 0.1, 8.0)


@pytest.mark.parametrize(
    "check",
    [
        check_shapes,
        check_ranges,
        check_intervals,
        check_repeatable,
        check_rays_alone,
        check_background,
        check_levels,
        lambda field: check_precision(field, field),
    ],
)
@pytest.mark.parametrize("field", [GaussianBlobs.random(), HomogeneousBall(0.7, 2.0)], ids=lambda f: type(f).__name__)
def test_closed_fields_keep_the_contract(field: RadianceField, check: Callable[[RadianceField], None]) -> None:
    check(field)


def test_blobs_are_differentiable_in_position(generator: torch.Generator) -> None:
    field = GaussianBlobs.random(3, seed=1)
    positions = (torch.rand((6, 3), generator=generator, dtype=torch.float64) - 0.5).requires_grad_()

    def answer(x: Tensor) -> tuple[Tensor, Tensor]:
        found = field.query(x, x)
        return found.density, found.rgb

    assert torch.autograd.gradcheck(answer, (positions,))
    assert torch.autograd.gradgradcheck(answer, (positions,))
