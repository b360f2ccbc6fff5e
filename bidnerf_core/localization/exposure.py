"""How much brighter an image is than the map: a gain and a bias for each colour, found along with the pose."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.robust import Robust

ROUNDS = 3
"""Of robust weighting."""

TRUST = 0.001
"""How much a gain of 1 and a bias of 0 count beside what is seen: enough where that is of one colour."""


@dataclass(frozen=True, eq=False)
class Exposure:
    """Measured colour is ``gain * rendered + bias``."""

    gain: Float[Tensor, "h 3"]
    bias: Float[Tensor, "h 3"]

    def applied(self, rendered: Float[Tensor, "h n 3"]) -> Float[Tensor, "h n 3"]:
        return self.gain[:, None] * rendered + self.bias[:, None]


def fit_exposure(
    rendered: Float[Tensor, "h n 3"],
    measured: Float[Tensor, "n 3"],
    share: Float[Tensor, "n 3"],
    colour: Robust,
) -> Exposure:
    """Least squares with robust weights, for each pose and colour on its own."""
    exposure = Exposure(torch.ones_like(rendered[:, 0]), torch.zeros_like(rendered[:, 0]))
    for _ in range(ROUNDS):
        weights = share * colour.weight(exposure.applied(rendered) - measured)
        total = weights.sum(1).clamp(min=torch.finfo(weights.dtype).tiny)
        mean_x = (weights * rendered).sum(1) / total
        mean_y = (weights * measured).sum(1) / total
        x, y = rendered - mean_x[:, None], measured - mean_y[:, None]
        gain = ((weights * x * y).sum(1) / total + TRUST) / ((weights * x * x).sum(1) / total + TRUST)
        exposure = Exposure(gain, mean_y - gain * mean_x)
    return exposure
