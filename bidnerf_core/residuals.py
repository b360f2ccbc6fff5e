"""How far a rendering is from what was measured."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bidnerf_core.observations import Observations
from bidnerf_core.rendering import Rendering
from bidnerf_core.robust import Robust, huber

__all__ = ["Objective", "depth", "free_space", "huber", "masked_mean", "objective", "photometric"]


@dataclass(frozen=True)
class Objective:
    """What a rendering is judged by: robust errors of colour, and of depth with its weight (lambda_d)."""

    colour: Robust
    depth: Robust  # its scale is in metres
    depth_weight: float
    free_space_weight: float = (
        0.0  # of matter that is rendered more than the scale of depth before what was measured
    )

    def __call__(self, rendering: Rendering, pixels: Observations) -> Float[Tensor, ""]:
        """``1/K sum_i [mean_r rho(rgb) + lambda_d mean_r rho(d)]`` (eqs. 5 and 6), for pixels of shape (views, pixels).

        The colour term sums rho over the three channels; the depth term is a mean over the rays where depth was measured.
        """
        colour = self.colour(photometric(rendering, pixels)).sum(-1).mean(-1)
        if not self.heeds_depth:
            return colour.mean()
        distance = masked_mean(self.depth(depth(rendering, pixels)), pixels.distance > 0)
        loss = (colour + self.depth_weight * distance).mean()
        return loss + self._in_front(rendering, pixels.distance)

    def on_depth_rays(self, rendering: Rendering, measured: Observations) -> Float[Tensor, ""]:
        """``lambda_d mean_r rho(d)``: the depth terms alone, on rays of their own."""
        loss = self.depth_weight * self.depth(rendering.distance - measured.distance).mean()
        return loss + self._in_front(rendering, measured.distance)

    @property
    def heeds_depth(self) -> bool:
        return self.depth_weight > 0 or self.free_space_weight > 0

    def _in_front(self, rendering: Rendering, distance: Float[Tensor, "*k p"]) -> Float[Tensor, ""] | float:
        if self.free_space_weight == 0:
            return 0.0
        found = self.depth(free_space(rendering, distance, self.depth.scale))
        return self.free_space_weight * masked_mean(found, distance > 0).mean()


def photometric(rendering: Rendering, pixels: Observations) -> Float[Tensor, "*p 3"]:
    """Rendered minus measured colour."""
    return rendering.rgb - pixels.rgb


def depth(rendering: Rendering, pixels: Observations) -> Float[Tensor, "*p"]:
    """Rendered minus measured distance, metres; 0 where nothing was measured."""
    return torch.where(pixels.distance > 0, rendering.distance - pixels.distance, 0)


def free_space(rendering: Rendering, distance: Float[Tensor, "*p"], margin: float) -> Float[Tensor, "*p"]:
    """How far, on average over the ray, its weight lies before the measured ``distance`` less ``margin``: metres.

    A sensor that measured depth saw nothing before it. Unlike an error of the mean distance, this is not content with
    matter on both sides. 0 where nothing was measured.
    """
    before = (distance[..., None] - margin - rendering.samples.middles).clamp(min=0)
    return (rendering.weights * before).sum(-1)


def masked_mean(values: Float[Tensor, "*k p"], mask: Bool[Tensor, "*k p"]) -> Float[Tensor, "*k"]:
    """Mean over the last axis where ``mask`` holds; 0 where it holds nowhere."""
    kept = torch.where(mask, values, 0)
    return kept.sum(-1) / mask.sum(-1).clamp(min=1)


def objective(
    rendering: Rendering, pixels: Observations, delta: float, depth_weight: float
) -> Float[Tensor, ""]:
    """The paper's: Huber's rho for colour and depth alike."""
    return Objective(Robust("huber", delta), Robust("huber", delta), depth_weight)(rendering, pixels)
