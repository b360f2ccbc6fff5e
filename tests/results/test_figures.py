"""Pictures: their sizes, what they show, and that odd input is drawn or refused but never garbled."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from bidnerf.results import as_picture, tile

# Inside: single tiles of an overlay, before they are put together
from bidnerf.results.overlays import blend, edges
from refusals import refused


def disc(column: float, size: int = 40) -> torch.Tensor:
    """An orange disc on white (h w 3), its middle at ``column``."""
    v, u = torch.meshgrid(torch.arange(size), torch.arange(size), indexing="ij")
    inside = ((u - column) ** 2 + (v - size / 2) ** 2 < 100)[..., None]
    return torch.where(inside, torch.tensor([0.88, 0.52, 0.12]), torch.ones(3))


def test_as_picture_takes_what_there_is() -> None:
    image = disc(20)
    expected = (image.numpy() * 255 + 0.5).astype(np.uint8)
    for same in (image, image.double(), image.clone().requires_grad_(), image.numpy(), expected):
        assert np.array_equal(as_picture(same), expected)
    grey = as_picture(torch.tensor([[0.0, 0.5], [1.0, 2.0]]))
    assert grey.shape == (2, 2, 3)
    assert grey[..., 0].tolist() == [[0, 128], [255, 255]]


def test_what_is_not_finite_is_clipped() -> None:
    odd = torch.tensor([[[float("nan"), float("inf"), -float("inf")], [-1.0, 2.0, 0.5]]])
    assert as_picture(odd).tolist() == [[[0, 255, 0], [0, 255, 128]]]


@pytest.mark.parametrize("shape", [(0, 4, 3), (4, 0, 3), (4, 4, 4), (4,), (2, 4, 4, 3), (0, 0)])
def test_what_is_no_image_is_refused(shape: tuple[int, ...]) -> None:
    got = (*shape, 3) if len(shape) == 2 else shape
    with refused(where="image", found=f"expected an image (height, width, 3), got shape {got}"):
        as_picture(torch.zeros(shape))


def test_blend_shows_one_contour_at_the_truth_and_two_elsewhere() -> None:
    def pink(image: np.ndarray) -> int:
        red, green, _ = np.moveaxis(image.astype(int), -1, 0)
        return int((red - green > 100).sum())

    assert pink(blend(disc(20), disc(20))) == 0
    assert pink(blend(disc(20), disc(12))) > 20


def test_edges_are_where_the_image_changes() -> None:
    strength = edges(disc(20))
    assert strength.shape == (40, 40)
    assert strength.max() == 1
    assert strength[20, 20] == strength[0, 0] == 0
    assert edges(np.full((5, 5, 3), 0.5)).max() == 0


def test_small_images_are_enlarged_and_large_ones_are_not() -> None:
    assert tile(disc(20), "small").shape[1] > 200
    assert tile(np.zeros((300, 400, 3)), "large").shape[1] < 420
