"""The exposure of an image relative to the map: a gain and an offset per colour channel, eliminated from the residual."""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

NEARLY_CLIPPED = 0.01
"""Distance from black or white, in [0, 1], within which an image's colours may be clipped."""


def fit_exposure(
    seen: Float[Tensor, "h n 3"],
    measured: Float[Tensor, "n 3"],
    weigh: Callable[[Float[Tensor, "h n 3"]], Float[Tensor, "h n 3"]],
    known: Float[Tensor, "#h n 1"],
    precision: tuple[float, float],
    rounds: int = 3,
) -> tuple[Float[Tensor, "h 1 3"], Float[Tensor, "h 1 3"]]:
    """Return the gain and the offset of the model ``measured = gain * seen + offset``, by reweighted least squares.

    ``weigh`` returns the weights of differences, at most 1; ``known`` (0 to 1) multiplies the weights. ``precision`` holds
    the precisions of Gaussian priors of the gain about 1 and the offset about 0, in the unit of the weights: they matter where the
    colours do not suffice, as in a channel that is constant over the image. The first of the ``rounds`` is unweighted.
    """
    weight = known.expand_as(seen)
    gain, offset = torch.ones_like(seen[:, :1]), torch.zeros_like(seen[:, :1])
    for number in range(rounds):
        if number > 0:
            corrected = gain * seen + offset
            # Colours that are clipped in the image and out of range in the rendering agree, but do not constrain the exposure.
            white = (measured > 1 - NEARLY_CLIPPED) & (corrected >= 1)
            clipped = white | ((measured < NEARLY_CLIPPED) & (corrected <= 0))
            weight = known * weigh(corrected - measured) * ~clipped
        difference = measured - seen
        total = weight.sum(1, keepdim=True) + precision[1]
        mean, shift = ((weight * part).sum(1, keepdim=True) for part in (seen, difference))
        square = (weight * seen.square()).sum(1, keepdim=True) + precision[0]
        grow = (weight * seen * difference).sum(1, keepdim=True)
        determinant = (total * square - mean.square()).clamp(min=torch.finfo(seen.dtype).tiny)
        gain = 1 + (total * grow - mean * shift) / determinant
        offset = (square * shift - mean * grow) / determinant
    return gain, offset


def eliminate(
    rows: Float[Tensor, "h n 3 p"], seen: Float[Tensor, "h n 3"], weight: Float[Tensor, "h n 3"]
) -> Float[Tensor, "h n 3 p"]:
    """Return the derivatives of the colours with gain and offset projected out (variable projection, Golub and Pereyra 1973)."""
    share = weight / weight.sum(1, keepdim=True).clamp(min=torch.finfo(weight.dtype).tiny)
    basis = seen - (share * seen).sum(1, keepdim=True)
    basis = basis * (share * basis.square()).sum(1, keepdim=True).clamp(min=1e-12).rsqrt()
    rows = rows - torch.einsum("hnc,hncp->hcp", share, rows)[:, None]
    return rows - basis[..., None] * torch.einsum("hnc,hncp->hcp", share * basis, rows)[:, None]
