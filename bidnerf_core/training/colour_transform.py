"""Exposure and white balance of each training image, learned jointly with the field."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn


class ColourTransforms(nn.Module):
    """A gain and an offset per colour channel and image, which transform rendered colours to the image's.

    Cameras choose exposure and white balance for each photo separately (Martin-Brualla et al. 2021, section
    4.1; here without a network, so that the transforms cannot explain geometry). Over the images, the
    logarithms of the gains and the offsets have mean 0: the field itself has the colours of a photo with mean
    exposure. Initially all transforms are the identity.
    """

    log_gain: Float[Tensor, "images 3"]
    offset: Float[Tensor, "images 3"]

    def __init__(self, images: int) -> None:
        super().__init__()
        self.log_gain = nn.Parameter(torch.zeros(images, 3))
        self.offset = nn.Parameter(torch.zeros(images, 3))

    def forward(self, rgb: Float[Tensor, "r 3"], image: Int[Tensor, "r"]) -> Float[Tensor, "r 3"]:
        """Transform the field's colours to those of each ray's image."""
        gain = (self.log_gain - self.log_gain.mean(dim=0)).exp()
        offset = self.offset - self.offset.mean(dim=0)
        # The derivative of an index in square brackets sorts the rays by image.
        return rgb * gain.index_select(0, image) + offset.index_select(0, image)

    def penalty(self) -> Float[Tensor, ""]:
        """Return the mean square of the log gains and the offsets; it keeps those that the images do not
        constrain at 0.
        """
        return self.log_gain.square().mean() + self.offset.square().mean()


def fitted_colours(rgb: Float[Tensor, "*p 3"], photo: Float[Tensor, "*p 3"]) -> Float[Tensor, "*p 3"]:
    """Apply to ``rgb`` the gain and offset per channel that fit it best to ``photo`` (least squares).

    They serve as the colour transform of an image outside the training set.
    """
    x, y = rgb.reshape(-1, 3).double(), photo.reshape(-1, 3).double()
    around = x - x.mean(0)
    gain = (around * y).sum(0) / around.square().sum(0).clamp(min=1e-12)
    fitted = (rgb.double() - x.mean(0)) * gain + y.mean(0)
    return fitted.to(rgb)
