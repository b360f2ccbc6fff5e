"""Small smooth images: convolution as scipy has it, slopes of known images, and no distortion left."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.ndimage import convolve1d
from torch import Generator, Tensor

from bidnerf_core.camera import Intrinsics
from bidnerf_core.frames import Frame, View
from bidnerf_core.geometry import SE3
from bidnerf_core.localization.costs.images import slopes, smooth, thumbnail
from bidnerf_core.scenes import orbit

PLAIN = Intrinsics(100.0, 104.0, 47.0, 33.0, 96, 64)
LENS = Intrinsics(100.0, 104.0, 47.0, 33.0, 96, 64, (-0.2, 0.05, 0.001, -0.002))


def even(camera: Intrinsics) -> Tensor:
    """Colours that change evenly with where a pixel looks."""
    x, y, _ = camera.unproject(camera.pixel_centres()).unbind(-1)
    return torch.stack([0.5 + 0.4 * x, 0.5 + 0.4 * y, 0.5 + 0.2 * x - 0.3 * y], -1)


def test_smooth_is_scipys_convolution(generator: Generator) -> None:
    image = torch.rand((2, 3, 9, 14), generator=generator)
    kernel = np.array([1, 4, 6, 4, 1]) / 16
    expected = convolve1d(
        convolve1d(image.numpy(), kernel, axis=-1, mode="nearest"), kernel, axis=-2, mode="nearest"
    )
    torch.testing.assert_close(smooth(image), torch.from_numpy(expected), rtol=0, atol=1e-6)


@pytest.mark.parametrize("camera", [PLAIN, LENS], ids=["pinhole", "lens"])
def test_where_its_pixels_look(camera: Intrinsics) -> None:
    T = orbit(3.0, 2, seed=0)[1]
    small = thumbnail(View(Frame("even", even(camera), camera), T), 24)
    assert (small.camera.width, small.camera.height) == (24, 16)
    assert small.camera.distortion == ()
    seen = small.rgb[:, 3:-3, 3:-3].flatten(1).T
    x, y, _ = small.flat.view(16, 24, 3)[3:-3, 3:-3].reshape(-1, 3).unbind(-1)
    expected = torch.stack([0.5 + 0.4 * x, 0.5 + 0.4 * y, 0.5 + 0.2 * x - 0.3 * y], -1)
    torch.testing.assert_close(seen, expected, rtol=0, atol=3e-3)
    inner = small.slopes.view(3, 16, 24, 2)[:, 4:-4, 4:-4].flatten(1, 2).mean(1)
    torch.testing.assert_close(inner, torch.tensor([[0.4, 0.0], [0.0, 0.4], [0.2, -0.3]]), rtol=0, atol=0.02)
    turned = T.to(torch.float32).rotate(small.flat * small.directness[:, None])
    torch.testing.assert_close(small.directions, turned)


def test_what_is_small_already_is_not_made_larger() -> None:
    small = thumbnail(View(Frame("even", even(PLAIN), PLAIN), SE3.identity()), 500)
    assert (small.camera.width, small.camera.height) == (96, 64)
    assert slopes(small.rgb, small.camera).shape == (3, 96 * 64, 2)
