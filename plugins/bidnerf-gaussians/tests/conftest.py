"""Random Gaussians."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch

from bidnerf_gaussians import Gaussians


@pytest.fixture
def some() -> Callable[..., Gaussians]:
    def make(count: int = 40, degree: int = 1, seed: int = 0) -> Gaussians:
        generator = torch.Generator().manual_seed(seed)

        def normal(*shape: int) -> torch.Tensor:
            return torch.randn(shape, generator=generator)

        return Gaussians(
            0.5 * normal(count, 3),
            -2 + 0.5 * normal(count, 3),
            torch.nn.functional.normalize(normal(count, 4), dim=-1),
            normal(count),
            0.3 * normal(count, (degree + 1) ** 2, 3),
        )

    return make
