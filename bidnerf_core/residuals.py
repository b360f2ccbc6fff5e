"""How far a rendering is from what was measured."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bidnerf_core.pixels import Pixels
from bidnerf_core.rendering import Rendering


def photometric(rendering: Rendering, pixels: Pixels) -> Float[Tensor, "*p 3"]:
    """Rendered minus measured colour."""
    return rendering.rgb - pixels.rgb


def depth(rendering: Rendering, pixels: Pixels) -> Float[Tensor, "*p"]:
    """Rendered minus measured distance, metres; 0 where nothing was measured."""
    return torch.where(pixels.distance > 0, rendering.distance - pixels.distance, 0)


def huber(residual: Float[Tensor, "*p"], delta: float) -> Float[Tensor, "*p"]:
    """Huber's rho: ``r^2 / 2`` up to ``delta``, then linear with slope ``delta``."""
    size = residual.abs()
    return torch.where(size <= delta, 0.5 * size**2, delta * (size - 0.5 * delta))


def masked_mean(values: Float[Tensor, "*k p"], mask: Bool[Tensor, "*k p"]) -> Float[Tensor, "*k"]:
    """Mean over the last axis where ``mask`` holds; 0 where it holds nowhere."""
    kept = torch.where(mask, values, 0)
    return kept.sum(-1) / mask.sum(-1).clamp(min=1)


def objective(rendering: Rendering, pixels: Pixels, delta: float, depth_weight: float) -> Float[Tensor, ""]:
    """``1/K sum_i [mean_r rho(rgb) + lambda_d mean_r rho(d)]`` (eqs. 5 and 6), for pixels of shape (views, pixels).

    The colour term sums rho over the three channels; the depth term is a mean over the rays where depth was measured.
    """
    colour = huber(photometric(rendering, pixels), delta).sum(-1).mean(-1)
    distance = masked_mean(huber(depth(rendering, pixels), delta), pixels.distance > 0)
    return (colour + depth_weight * distance).mean()
