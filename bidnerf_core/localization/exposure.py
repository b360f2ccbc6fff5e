"""Exposure of an image relative to the map: a gain and a bias per colour channel."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bidnerf_core.geometry import Robust

EXPOSURE_ROUNDS = 6
"""Number of iterations of robust reweighting for the fit of the exposure."""
EXPOSURE_PRIOR = 0.001
"""Precision of the gain's prior, relative to the sum of weights. It matters only if everything in view has one colour."""
NEARLY_CLIPPED = 0.01
"""Distance from black or white, in [0, 1], within which an image's colours may be clipped."""


@dataclass(frozen=True, eq=False)
class Exposure:
    """The model ``measured = gain * rendered + bias`` of each channel, for each of h poses."""

    gain: Float[Tensor, "h c"]
    bias: Float[Tensor, "h c"]

    def applied(self, rendered: Float[Tensor, "h c n"]) -> Float[Tensor, "h c n"]:
        return self.gain[..., None] * rendered + self.bias[..., None]


def clipped(seen: Float[Tensor, "*s"], measured: Float[Tensor, "#*s"]) -> Bool[Tensor, "*s"]:
    """Return a mask of the colours clipped in the image for which the exposed rendering ``seen`` is out of range too.

    Such colours agree with the exposure whatever the difference, but do not constrain it.
    """
    return ((measured > 1 - NEARLY_CLIPPED) & (seen >= 1)) | ((measured < NEARLY_CLIPPED) & (seen <= 0))


def fit_exposure(
    rendered: Float[Tensor, "h c n"],
    measured: Float[Tensor, "#h c n"],
    weights: Float[Tensor, "h #c n"],
    gain_precision: Float[Tensor, "*#h"] | float,
    bias_precision: float = 0.0,
) -> Exposure:
    """Return the gain and the bias by weighted least squares, with Gaussian priors about 1 and 0.

    A precision is the inverse variance of a prior, in the unit of ``weights``. The prior matters where the data are not
    sufficient, as in a channel that is constant over the image.
    """
    off = measured - rendered
    total = weights.sum(-1).expand(rendered.shape[:2]) + bias_precision
    mean, square = (weights * rendered).sum(-1), (weights * rendered**2).sum(-1) + gain_precision
    shift, grow = (weights * off).sum(-1), (weights * rendered * off).sum(-1)
    # If all weights are 0, there is no correction.
    determinant = (total * square - mean**2).clamp(min=torch.finfo(rendered.dtype).tiny)
    gain = 1 + (total * grow - mean * shift) / determinant
    return Exposure(gain, (square * shift - mean * grow) / determinant)


def robust_exposure(
    rendered: Float[Tensor, "h c n"], measured: Float[Tensor, "c n"], weights: Float[Tensor, "c n"], robust: Robust
) -> Exposure:  # fmt: skip
    """Fit the exposure at each pose by iteratively reweighted least squares; clipped colours have no weight.

    The iteration starts at a gain of 1. With a redescending loss, it converges for images up to two stops darker, but only one
    stop brighter.
    """
    rendered = torch.where(weights > 0, rendered, 0)
    exposure = Exposure(torch.ones_like(rendered[..., 0]), torch.zeros_like(rendered[..., 0]))
    for _ in range(EXPOSURE_ROUNDS):
        seen = exposure.applied(rendered)
        factors = weights * robust.weight(seen - measured) * ~clipped(seen, measured)
        exposure = fit_exposure(rendered, measured[None], factors, EXPOSURE_PRIOR * factors.sum(-1))
    return exposure
