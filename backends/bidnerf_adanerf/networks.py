"""The two networks of AdaNeRF and the encoding of their inputs."""

from __future__ import annotations

from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from bidnerf_core.fields import encoding_width, frequency_encoding, octaves


def encode(points: Float[Tensor, "*p 3"], frequencies: int) -> Float[Tensor, "*p f"]:
    """Return the frequency encoding of points in the cube [-1, 1], sines first, as stored networks expect it."""
    return frequency_encoding(points, octaves(frequencies, points), sines_first=True)


def trunk(inputs: int, width: int, layers: int) -> nn.Sequential:
    """Return ``layers`` hidden layers, each followed by a ReLU."""
    widths = [inputs, *[width] * layers]
    pairs = pairwise(widths)
    return nn.Sequential(*(m for a, b in pairs for m in (nn.Linear(a, b), nn.ReLU(inplace=True))))


class ShadingNetwork(nn.Module):
    """The MLP of NeRF without its skip connection: maps position to density and, with the direction, to colour."""

    def __init__(self, width: int, layers: int, position_frequencies: int, direction_frequencies: int) -> None:
        super().__init__()
        self.frequencies = position_frequencies, direction_frequencies
        self.trunk = trunk(encoding_width(position_frequencies), width, layers)
        self.density = nn.Linear(width, 1)
        self.view = nn.Linear(width + encoding_width(direction_frequencies), max(1, width // 2))
        self.colour = nn.Linear(max(1, width // 2), 3)

    def forward(
        self, points: Float[Tensor, "p 3"], directions: Float[Tensor, "p 3"]
    ) -> tuple[Float[Tensor, "p"], Float[Tensor, "p 3"]]:
        """Return density before its activation, and rgb in [0, 1], at ``points`` of the cube [-1, 1]."""
        hidden = self.trunk(encode(points, self.frequencies[0]))
        turned = encode(directions, self.frequencies[1])
        seen = functional.relu(self.view(torch.cat([hidden, turned], dim=-1)), inplace=True)
        return self.density(hidden)[:, 0], torch.sigmoid(self.colour(seen))


class Oracle(nn.Module):
    """The sampling network: scores all bins of a ray in one evaluation, given only the ray.

    Its inputs are points evenly spaced along the ray's segment in the scene, from entry to exit. Rays
    that see the same part of the scene thus have similar inputs, whether their camera is outside or inside.
    """

    places: Float[Tensor, "k"]

    def __init__(self, width: int, layers: int, points: int, frequencies: int, bins: int) -> None:
        super().__init__()
        self.frequencies = frequencies
        self.register_buffer("places", torch.linspace(0, 1, points), persistent=False)
        self.trunk = trunk(points * encoding_width(frequencies), width, layers)
        self.scores = nn.Linear(width, bins)
        nn.init.constant_(self.scores.bias, FULL)

    def forward(self, points: Float[Tensor, "r k 3"]) -> Float[Tensor, "r n"]:
        """Return the logits of the bins' scores, from points (in the cube [-1, 1]) at the fractions ``places`` of each ray's segment."""
        return self.scores(self.trunk(encode(points, self.frequencies).flatten(1)))


FULL = 3.0
"""Logit of the scores before training: high enough for all bins to count, low enough for the gradient not to vanish."""
