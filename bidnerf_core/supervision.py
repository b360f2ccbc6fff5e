"""What a rendering of training rays is compared with: colour, and depth where it was measured."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.rendering import Rendering
from bidnerf_core.training import RayBatch


def supervised_loss(
    rendering: Rendering, batch: RayBatch, side: float, depth_weight: float
) -> tuple[Float[Tensor, ""], float]:
    """Squared error of colour plus ``depth_weight`` times the depth term; and the colour term alone, for display.

    The depth term is the mean distance, in parts of ``side`` (metres), of each ray's weight from where its depth was
    measured: like the ray termination loss of DS-NeRF (Deng et al. 2022) it wants all weight there, and unlike an error
    of the mean depth it is not content with weight on both sides. Weight that a ray lacks counts as if at the camera.
    """
    error = (rendering.rgb - batch.rgb) ** 2
    mse = float(error.detach().mean())
    return error.mean() + depth_weight * depth_term(rendering, batch) / side, mse


def depth_term(rendering: Rendering, batch: RayBatch) -> Float[Tensor, ""]:
    """Metres, mean over the rays whose depth was measured; 0 where there are none."""
    measured = batch.distance > 0
    away = (rendering.weights * (rendering.samples.middles - batch.distance[:, None]).abs()).sum(-1)
    missing = (1 - rendering.opacity) * batch.distance
    return torch.where(measured, away + missing, 0).sum() / measured.sum().clamp(min=1)
