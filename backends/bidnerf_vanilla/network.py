"""The MLP of NeRF (Mildenhall et al. 2020, figure 7)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from bidnerf_core.fields import encoding_width, frequency_encoding, octaves
from bidnerf_core.settings import Count, Layers, Range, Settings


@dataclass(frozen=True)
class NetworkConfig(Settings):
    """Size of one MLP."""

    layers: Layers = 4  # hidden layers before the density
    width: Count = 128  # units of a hidden layer; the layer that takes the direction has half of them
    skip: Annotated[int, Range(0)] = 2  # number of layers before the position is fed in once more; 0: never
    # octaves of sines and cosines of the position; the first period is the scene's longest side
    position_frequencies: Annotated[int, Range(0, 64)] = 8
    direction_frequencies: Annotated[int, Range(0, 64)] = 2  # octaves of sines and cosines of the direction
    include_input: bool = True  # feed in positions and directions themselves, besides their sines


class NerfNetwork(nn.Module):
    """Maps encoded positions to raw density and, with encoded directions, to colour.

    The paper's linear layer between the two parts has no activation, so it is merged with the linear layer that follows.
    """

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        seen = encoding_width(config.position_frequencies, config.include_input)
        turned = encoding_width(config.direction_frequencies, config.include_input)
        inputs = [config.width + seen * self._is_fed(number) for number in range(1, config.layers)]
        self.trunk = nn.ModuleList(nn.Linear(count, config.width) for count in (seen, *inputs))
        self.density = nn.Linear(config.width, 1)
        self.view = nn.Linear(config.width + turned, max(1, config.width // 2))
        self.colour = nn.Linear(max(1, config.width // 2), 3)

    def _is_fed(self, number: int) -> bool:
        """Return whether a layer takes the encoded position as well as the previous layer's output."""
        return number == self.config.skip > 0

    def forward(
        self, points: Float[Tensor, "p 3"], directions: Float[Tensor, "p 3"]
    ) -> tuple[Float[Tensor, "p"], Float[Tensor, "p 3"]]:
        """Return density before its activation, and rgb in [0, 1], at ``points`` of the cube [-1, 1]."""
        config = self.config
        factors = [octaves(count, points) for count in (config.position_frequencies, config.direction_frequencies)]
        position = frequency_encoding(points, factors[0], config.include_input)
        direction = frequency_encoding(directions, factors[1], config.include_input)
        hidden = position
        for number, layer in enumerate(self.trunk):
            given = torch.cat([hidden, position], dim=-1) if self._is_fed(number) else hidden
            hidden = functional.relu(layer(given), inplace=True)
        looked = functional.relu(self.view(torch.cat([hidden, direction], dim=-1)), inplace=True)
        return self.density(hidden)[:, 0], torch.sigmoid(self.colour(looked))
