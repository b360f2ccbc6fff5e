"""The supervised loss: colour, and depth where it was measured."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.rendering import Rendering
from bidnerf_core.training.ray_bank import TrainingBatch


def supervised_loss(
    rendering: Rendering, batch: TrainingBatch, side: float, depth_weight: float
) -> tuple[Float[Tensor, ""], float]:
    """Return the squared error of colour plus ``depth_weight`` times the depth term, and the colour term alone for display.

    The depth term (``ray_termination``) is a fraction of ``side``, the scene's longest side (metres).
    """
    error = (rendering.rgb - batch.observed.rgb) ** 2
    mse = float(error.detach().mean())
    return error.mean() + depth_weight * ray_termination(rendering, batch) / side, mse


def ray_termination(rendering: Rendering, batch: TrainingBatch) -> Float[Tensor, ""]:
    """Return the mean distance (metres) of a ray's weight from its measured depth; 0 where no ray has any.

    Like the ray termination loss of DS-NeRF (Deng et al. 2022) it is least where all weight is at the measured depth; an
    error of the mean depth would also be 0 with equal weight on both sides. Weight that a ray lacks counts as at the camera.
    """
    distance, measured = batch.observed.distance, batch.observed.measured
    away = (rendering.weights * (rendering.samples.middles - distance[:, None]).abs()).sum(-1)
    missing = (1 - rendering.opacity) * distance
    return torch.where(measured, away + missing, 0).sum() / measured.sum().clamp(min=1)
