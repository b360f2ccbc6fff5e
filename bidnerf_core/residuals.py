"""How far a rendering is from what was measured."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bidnerf_core.depth_rays import DepthRays
from bidnerf_core.pixels import Pixels
from bidnerf_core.rendering import Rendering
from bidnerf_core.robust import Robust, huber

__all__ = ["Objective", "depth", "huber", "masked_mean", "objective", "photometric"]


@dataclass(frozen=True)
class Objective:
    """What a rendering is judged by: robust errors of colour, and of depth with its weight (lambda_d)."""

    colour: Robust
    depth: Robust  # its scale is in metres
    depth_weight: float

    def __call__(self, rendering: Rendering, pixels: Pixels) -> Float[Tensor, ""]:
        """``1/K sum_i [mean_r rho(rgb) + lambda_d mean_r rho(d)]`` (eqs. 5 and 6), for pixels of shape (views, pixels).

        The colour term sums rho over the three channels; the depth term is a mean over the rays where depth was measured.
        """
        colour = self.colour(photometric(rendering, pixels)).sum(-1).mean(-1)
        if self.depth_weight == 0:
            return colour.mean()
        distance = masked_mean(self.depth(depth(rendering, pixels)), pixels.distance > 0)
        return (colour + self.depth_weight * distance).mean()

    def on_depth_rays(self, rendering: Rendering, measured: DepthRays) -> Float[Tensor, ""]:
        """``lambda_d mean_r rho(d)``: the depth term alone, on rays of their own."""
        return self.depth_weight * self.depth(rendering.distance - measured.distance).mean()


def photometric(rendering: Rendering, pixels: Pixels) -> Float[Tensor, "*p 3"]:
    """Rendered minus measured colour."""
    return rendering.rgb - pixels.rgb


def depth(rendering: Rendering, pixels: Pixels) -> Float[Tensor, "*p"]:
    """Rendered minus measured distance, metres; 0 where nothing was measured."""
    return torch.where(pixels.distance > 0, rendering.distance - pixels.distance, 0)


def masked_mean(values: Float[Tensor, "*k p"], mask: Bool[Tensor, "*k p"]) -> Float[Tensor, "*k"]:
    """Mean over the last axis where ``mask`` holds; 0 where it holds nowhere."""
    kept = torch.where(mask, values, 0)
    return kept.sum(-1) / mask.sum(-1).clamp(min=1)


def objective(rendering: Rendering, pixels: Pixels, delta: float, depth_weight: float) -> Float[Tensor, ""]:
    """The paper's: Huber's rho for colour and depth alike."""
    return Objective(Robust("huber", delta), Robust("huber", delta), depth_weight)(rendering, pixels)
