"""Exposure and white balance of each training image, learned beside the field."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn


class ColourTransforms(nn.Module):
    """A gain and an offset of each colour channel and image, by which rendered colours become those of the image.

    Cameras choose exposure and white balance anew for each photo (Martin-Brualla et al. 2021, section 4.1; here without a
    network, so that it cannot explain geometry). The mean logarithm of the gains over the images is 0, and so is that of the
    offsets: the field itself has the colours of a photo of mean exposure. At first all transforms are the identity.
    """

    log_gain: Float[Tensor, "images 3"]
    offset: Float[Tensor, "images 3"]

    def __init__(self, images: int) -> None:
        super().__init__()
        self.log_gain = nn.Parameter(torch.zeros(images, 3))
        self.offset = nn.Parameter(torch.zeros(images, 3))

    def forward(self, rgb: Float[Tensor, "r 3"], image: Int[Tensor, "r"]) -> Float[Tensor, "r 3"]:
        """Return the field's colours as they are in the given image of each ray."""
        gain = (self.log_gain - self.log_gain.mean(dim=0)).exp()
        offset = self.offset - self.offset.mean(dim=0)
        return rgb * gain[image] + offset[image]

    def penalty(self) -> Float[Tensor, ""]:
        """Return the mean square of the logarithmic gains and of the offsets, which keeps what images do not show at 0."""
        return self.log_gain.square().mean() + self.offset.square().mean()


def fitted_colours(rgb: Float[Tensor, "*p 3"], photo: Float[Tensor, "*p 3"]) -> Float[Tensor, "*p 3"]:
    """Return ``rgb`` with the gain and the offset of each channel that bring it nearest to ``photo`` (least squares).

    These are the colour transform of an image that was not trained on.
    """
    x, y = rgb.reshape(-1, 3).double(), photo.reshape(-1, 3).double()
    around = x - x.mean(0)
    gain = (around * y).sum(0) / around.square().sum(0).clamp(min=1e-12)
    fitted = (rgb.double() - x.mean(0)) * gain + y.mean(0)
    return fitted.to(rgb)
