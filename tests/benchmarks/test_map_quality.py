"""The quality of maps: unseen images are compared after their exposure was fitted in closed form."""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType

import numpy as np
import torch


def test_fitted_colours_are_those_of_numpys_least_squares(script: Callable[[str], ModuleType]) -> None:
    generator = torch.Generator().manual_seed(3)
    rgb, noise = torch.rand(500, 3, generator=generator), torch.randn(500, 3, generator=generator)
    photo = rgb * torch.tensor([0.5, 1.4, 0.9]) + 0.1 + 0.05 * noise
    fitted = script("map_quality").fit_colours(rgb, photo)
    for channel in range(3):
        line = np.polyfit(rgb[:, channel].numpy(), photo[:, channel].numpy(), 1)
        np.testing.assert_allclose(fitted[:, channel], np.polyval(line, rgb[:, channel].numpy()), atol=1e-5)


def test_an_even_image_is_fitted_by_its_mean(script: Callable[[str], ModuleType]) -> None:
    flat = torch.full((20, 3), 0.4)
    torch.testing.assert_close(script("map_quality").fit_colours(flat, flat + 0.25), flat + 0.25)
