"""The network that krrish94/nerf-pytorch calls ``FlexibleNeRFModel``, including tensor names."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import torch
from jaxtyping import Float
from torch import Tensor, nn

from bidnerf_core.fields import encoding_width, frequency_encoding
from bidnerf_core.fields import octaves as powers_of_two
from bidnerf_core.settings import Count, Range, Settings


@dataclass(frozen=True)
class NetworkConfig(Settings):
    """Architecture of one network."""

    layers: Count = 4  # hidden layers before the density
    # units of a hidden layer; the layer that takes the direction has half of them
    width: Annotated[int, Range(2, 10**7)] = 128
    skips: tuple[int, ...] = ()  # number of layers before each one that takes the position once more
    # number of frequencies of the position's sines and cosines
    position_frequencies: Annotated[int, Range(0, 64)] = 10
    position_input: bool = True  # feed in the position itself, besides its sines
    # number of frequencies of the direction's sines and cosines
    direction_frequencies: Annotated[int, Range(0, 64)] = 4
    direction_input: bool = True  # feed in the direction itself, besides its sines
    octaves: bool = True  # frequencies 1, 2, 4 ... 2^(n-1); otherwise n in equal steps between the same ends
    view_dependent: bool = True  # whether colour depends on the direction


class Network(nn.Module):
    """Maps positions (world) and unit directions to raw density and colour.

    As in the original, the first layer has no activation. Unlike in the original, the density is initially a
    thin fog: if a ReLU made it zero everywhere, there would be no gradient to recover with.
    """

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        width, seen = config.width, encoding_width(config.position_frequencies, config.position_input)
        turned = encoding_width(config.direction_frequencies, config.direction_input)
        self.layer1 = nn.Linear(seen, width)
        inputs = [width + seen * (number in config.skips) for number in range(1, config.layers)]
        self.layers_xyz = nn.ModuleList(nn.Linear(count, width) for count in inputs)
        if config.view_dependent:
            self.layers_dir = nn.ModuleList([nn.Linear(width + turned, width // 2)])
            self.fc_alpha, self.fc_rgb = nn.Linear(width, 1), nn.Linear(width // 2, 3)
            self.fc_feat = nn.Linear(width, width)
        else:
            self.fc_out = nn.Linear(width, 4)
        nn.init.ones_(self.fc_alpha.bias if config.view_dependent else self.fc_out.bias[3:])

    def forward(
        self, positions: Float[Tensor, "p 3"], directions: Float[Tensor, "p 3"]
    ) -> tuple[Float[Tensor, "p"], Float[Tensor, "p 3"]]:
        """Return density and colour, both before their activation."""
        config = self.config
        position = encoded(positions, config.position_frequencies, config.position_input, config.octaves)
        hidden = self.layer1(position)
        for number, layer in enumerate(self.layers_xyz, start=1):
            given = torch.cat([hidden, position], dim=-1) if number in config.skips else hidden
            hidden = layer(given).relu()
        if not config.view_dependent:
            rgb, density = self.fc_out(hidden).split([3, 1], dim=-1)
            return density[:, 0], rgb
        direction = encoded(directions, config.direction_frequencies, config.direction_input, config.octaves)
        looked = self.layers_dir[0](torch.cat([self.fc_feat(hidden).relu(), direction], dim=-1)).relu()
        return self.fc_alpha(hidden)[:, 0], self.fc_rgb(looked)


def encoded(points: Float[Tensor, "p 3"], frequencies: int, include_input: bool, octaves: bool) -> Float[Tensor, "p f"]:
    """Return ``(p, sin f1 p, cos f1 p, sin f2 p, ...)`` in nerf-pytorch's order: unlike in NeRF's eq. 4 there
    is no pi.
    """
    if octaves:
        factors = powers_of_two(frequencies, points, lowest=1.0)
    else:
        steps = torch.arange(frequencies, dtype=points.dtype, device=points.device)
        factors = 1 + steps * ((2.0 ** (frequencies - 1) - 1) / max(1, frequencies - 1))
    return frequency_encoding(points, factors, include_input)
