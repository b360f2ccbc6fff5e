"""Exposure and white balance of each training image, learned jointly with the field."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn


class ColourTransforms(nn.Module):
    """A gain and an offset per colour channel and image, which transform rendered colours to those of the image.

    Cameras choose exposure and white balance anew for each photo (Martin-Brualla et al. 2021, section 4.1; here without a
    network, so that the transforms cannot explain geometry). Over the images, the logarithms of the gains and the offsets
    have mean 0: the field itself has the colours of a photo of mean exposure. Initially all transforms are the identity.
    """

    log_gain: Float[Tensor, "images 3"]
    offset: Float[Tensor, "images 3"]

    def __init__(self, images: int) -> None:
        super().__init__()
        self.log_gain = nn.Parameter(torch.zeros(images, 3))
        self.offset = nn.Parameter(torch.zeros(images, 3))

    def forward(self, rgb: Float[Tensor, "r 3"], image: Int[Tensor, "r"]) -> Float[Tensor, "r 3"]:
        """Return the field's colours transformed to those of each ray's image."""
        gain = (self.log_gain - self.log_gain.mean(dim=0)).exp()
        offset = self.offset - self.offset.mean(dim=0)
        return rgb * gain[image] + offset[image]

    def penalty(self) -> Float[Tensor, ""]:
        """Return the mean square of the logarithmic gains and the offsets; it keeps those that the images leave open at 0."""
        return self.log_gain.square().mean() + self.offset.square().mean()


def fitted_colours(rgb: Float[Tensor, "*p 3"], photo: Float[Tensor, "*p 3"]) -> Float[Tensor, "*p 3"]:
    """Return ``rgb`` after the gain and offset per channel that best fit it to ``photo`` (least squares).

    These serve as the colour transform of an image that was not in the training set.
    """
    x, y = rgb.reshape(-1, 3).double(), photo.reshape(-1, 3).double()
    around = x - x.mean(0)
    gain = (around * y).sum(0) / around.square().sum(0).clamp(min=1e-12)
    fitted = (rgb.double() - x.mean(0)) * gain + y.mean(0)
    return fitted.to(rgb)
