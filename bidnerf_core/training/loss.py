"""The supervised loss: colour, up to each image's exposure, and depth where a sensor or a landmark provides it."""

from __future__ import annotations

from math import pi, sqrt

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from bidnerf_core.devices import may_wait
from bidnerf_core.fields import Rendering
from bidnerf_core.training.ray_bank import TrainingBatch


def supervised_loss(
    rendering: Rendering,
    batch: TrainingBatch,
    side: float,
    depth_weight: float,
    colour_weight: Float[Tensor, "r"] | None = None,
) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
    """Return the loss, and the unweighted mean squared error of colour for display.

    The loss is the mean squared error of colour plus ``depth_weight`` times the depth term (``ray_termination``) as a fraction
    of ``side``, the scene's longest side (metres). ``colour_weight`` is the weight of each ray's colour, 1 by default.
    """
    error = (rendering.rgb - batch.observed.rgb) ** 2
    mse = error.detach().mean()
    if colour_weight is not None:
        error = error * colour_weight[:, None]
    loss = error.mean()
    return loss + depth_weight * ray_termination(rendering, batch) / side if depth_weight else loss, mse


def ray_termination(rendering: Rendering, batch: TrainingBatch) -> Float[Tensor, ""]:
    """Return the mean distance (metres) of the rays' weight from their measured depth; 0 if no ray has a measurement.

    Like the ray termination loss of DS-NeRF (Deng et al. 2022), it is smallest if all weight is at the measured depth; an error of the mean
    depth could also be 0 with equal weight on both sides. If a ray's weights sum to less than 1, the rest counts as if it were at the
    camera. For distances from landmarks, the mean is also taken over their normal distribution, so that weight within the standard
    deviation is hardly moved.
    """
    measured, distance, deviation = batch.observed.measured, batch.observed.distance, batch.deviation
    weights, middles, opacity = rendering.weights, rendering.samples.middles, rendering.opacity
    if may_wait(measured.device):  # if no sensor measured depth, few rays have a landmark
        index = measured.nonzero()[:, 0]
        measured, distance, deviation, weights, middles, opacity = (
            part.index_select(0, index) for part in (measured, distance, deviation, weights, middles, opacity)
        )
    away = (weights * expected_distance(middles - distance[:, None], deviation[:, None])).sum(-1)
    return torch.where(measured, away + (1 - opacity) * distance, 0).sum() / measured.sum().clamp(min=1)


def expected_distance(offset: Float[Tensor, "*p"], deviation: Float[Tensor, "*#p"]) -> Float[Tensor, "*p"]:
    """Return the mean of ``|offset + e|`` for normal errors ``e`` with standard deviation ``deviation`` (folded normal)."""
    sigma = deviation.clamp(min=torch.finfo(offset.dtype).tiny)
    ratio = (offset / sigma).clamp(-30, 30)
    mean = sigma * sqrt(2 / pi) * torch.exp(-ratio.square() / 2) + offset * torch.erf(ratio / sqrt(2))
    return torch.where(deviation > 0, mean, offset.abs())


def distortion(rendering: Rendering, side: float) -> Float[Tensor, ""]:
    """Return the mean distortion of the rays' weights (Barron et al. 2022, eq. 15), with lengths in units of ``side``.

    The distortion is smallest if a ray's weight is in one short interval. Sums over pairs are computed from cumulative
    sums.
    """
    samples, weights = rendering.samples, rendering.weights
    middles, widths = samples.middles / side, (samples.ends - samples.starts) / side
    before, moment = weights.cumsum(-1) - weights, (weights * middles).cumsum(-1) - weights * middles
    pairs = 2 * (weights * (middles * before - moment)).sum(-1)
    return (pairs + (weights.square() * widths).sum(-1) / 3).mean()


class ColourTransforms(nn.Module):
    """A gain and an offset per colour channel and image, which transform rendered colours to those of the image.

    Cameras choose exposure and white balance for each photo separately (Martin-Brualla et al. 2021, section
    4.1; here without a network, so that the transforms cannot explain geometry). Over the images, the
    logarithms of the gains and the offsets have mean 0: the field itself has the colours of a photo with mean
    exposure. Initially, all transforms are the identity.
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
        # The backward pass of indexing with square brackets would sort the rays by image.
        return rgb * gain.index_select(0, image) + offset.index_select(0, image)

    def penalty(self) -> Float[Tensor, ""]:
        """Return the mean square of the log gains and offsets, a penalty that keeps at 0 those that the images do not constrain."""
        return self.log_gain.square().mean() + self.offset.square().mean()
