"""The exposure of an image relative to the map: a gain and a bias for each colour channel."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Exposure:
    """The model ``measured = gain * rendered + bias``, of each channel from each of h poses."""

    gain: Float[Tensor, "h c"]
    bias: Float[Tensor, "h c"]

    def applied(self, rendered: Float[Tensor, "h c n"]) -> Float[Tensor, "h c n"]:
        return self.gain[..., None] * rendered + self.bias[..., None]


def fit_exposure(
    rendered: Float[Tensor, "h c n"],
    measured: Float[Tensor, "#h c n"],
    weights: Float[Tensor, "h #c n"],
    gain_precision: Float[Tensor, "*#h"] | float,
    bias_precision: float = 0.0,
) -> Exposure:
    """Return the gain and the bias of weighted least squares with Gaussian priors about 1 and 0.

    A precision is the inverse variance of its prior, in the unit of ``weights``. The prior decides where the data do not,
    as in a channel that is constant over the image.
    """
    off = measured - rendered
    total = weights.sum(-1).expand(rendered.shape[:2]) + bias_precision
    mean, square = (weights * rendered).sum(-1), (weights * rendered**2).sum(-1) + gain_precision
    shift, grow = (weights * off).sum(-1), (weights * rendered * off).sum(-1)
    # If all weights are 0, there is no correction.
    determinant = (total * square - mean**2).clamp(min=torch.finfo(rendered.dtype).tiny)
    gain = 1 + (total * grow - mean * shift) / determinant
    return Exposure(gain, (square * shift - mean * grow) / determinant)
