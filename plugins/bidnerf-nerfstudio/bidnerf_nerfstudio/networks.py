"""The building blocks of nerfstudio's fields: hash encoding, layers, spherical harmonics."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated

import torch
from jaxtyping import Float
from torch import Tensor, nn

from bidnerf_core.devices import constant
from bidnerf_core.errors import InputError
from bidnerf_core.fields import SceneBounds, contract_points
from bidnerf_core.settings import Count, Layers, Range, Settings

PRIMES = (1, 2654435761, 805459861)
"""Factors of the coordinates in the hash (Müller et al. 2022, eq. 4)."""


@dataclass(frozen=True)
class HashConfig(Settings):
    """A multiresolution hash encoding, and the layers that follow it."""

    levels: Annotated[int, Range(1, 64)] = 16  # levels of resolution
    features: Annotated[int, Range(1, 64)] = 2  # features of an entry
    log2_table_size: Annotated[int, Range(1, 30)] = 19  # entries of a level's table, as a power of two
    base_resolution: Annotated[int, Range(1, 2**20)] = 16  # cells along a side at the coarsest level
    finest_resolution: Annotated[int, Range(1, 2**20)] = 2048  # cells along a side at the finest level
    width: Count = 64  # units of a hidden layer
    layers: Layers = 2  # layers of weights, the last one included

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.base_resolution > self.finest_resolution:
            raise InputError(
                f"base_resolution is {self.base_resolution}",
                expected=f"{self.finest_resolution} (finest_resolution) or less",
            )


class HashEncoding(nn.Module):
    """Positions in the unit cube encoded as the concatenated features of all levels, all of which are hashed."""

    def __init__(self, config: HashConfig) -> None:
        super().__init__()
        self.size = 2**config.log2_table_size
        count = config.levels
        growth = 1.0
        if count > 1:
            ratio = math.log(config.finest_resolution) - math.log(config.base_resolution)
            growth = math.exp(ratio / (count - 1))
        # In single precision as in nerfstudio, since the discarded fraction determines the resolution.
        self.resolutions: tuple[float, ...] = tuple(
            torch.floor(config.base_resolution * growth ** torch.arange(count)).tolist()
        )
        table = torch.rand(self.size * count, config.features) * 2 - 1
        self.table = nn.Parameter(table * 1e-3)  # the largest entry of an untrained table

    def forward(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n w"]:
        """Return the features of each level after those of the level before."""
        return torch.cat([self._level(points, number) for number in range(len(self.resolutions))], dim=-1)

    def _level(self, points: Float[Tensor, "n 3"], number: int) -> Float[Tensor, "n f"]:
        scaled = points * self.resolutions[number]
        lower = scaled.detach().floor()
        x, y, z = (scaled - lower).unbind(-1)
        corner = lower.long()
        a, b, c = (torch.stack([corner[:, axis], corner[:, axis] + 1]) * prime for axis, prime in enumerate(PRIMES))
        places = (a[:, None, None] ^ b[None, :, None] ^ c[None, None]) & (self.size - 1)
        entries = self.table.index_select(0, places.reshape(-1) + number * self.size)
        found = entries.reshape(2, 2, 2, len(points), entries.shape[-1])
        for weight in (x, y, z):
            found = torch.lerp(found[0], found[1], weight[:, None].expand_as(found[0]))
        return found


class Perceptron(nn.Module):
    """Linear layers with ReLU between them."""

    def __init__(self, inputs: int, width: int, outputs: int, layers: int, skip: int | None = None) -> None:
        super().__init__()
        self.skip = skip  # index of the layer that receives the input again
        widths = [inputs, *[width] * (layers - 1), outputs]
        self.layers = nn.ModuleList(
            nn.Linear(a + (inputs if number == skip else 0), b) for number, (a, b) in enumerate(pairwise(widths))
        )

    def forward(self, given: Float[Tensor, "n i"]) -> Float[Tensor, "n o"]:
        """Return the outputs, without an activation."""
        found = given
        for number, layer in enumerate(self.layers):
            if number:
                found = found.relu()
            if number == self.skip:
                found = torch.cat([given, found], dim=-1)
            found = layer(found)
        return found


class HashNetwork(nn.Module):
    """A hash encoding followed by layers."""

    def __init__(self, config: HashConfig, outputs: int) -> None:
        super().__init__()
        self.encoding = HashEncoding(config)
        self.head = Perceptron(config.levels * config.features, config.width, outputs, config.layers)

    def forward(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n o"]:
        """Return the outputs at points of the unit cube."""
        found: Tensor = self.head(self.encoding(points))
        return found


def unit_cube(positions: Float[Tensor, "p 3"], box: SceneBounds) -> tuple[Float[Tensor, "p 3"], Float[Tensor, "p"]]:
    """Return positions (training coordinates) in [0, 1], 0 if outside, and a mask that is 1 inside and 0 outside.

    In a contracted scene, all space within a cube around the origin fills the inner half of each axis,
    regardless of its box.
    """
    if box.contracted:
        points = (contract_points(positions) + 2) / 4
    else:
        points = (positions - constant(box.lower, positions)) / constant(box.size, positions)
    inside = ((points > 0) & (points < 1)).all(-1)
    return torch.where(inside[:, None], points, 0), inside.to(points.dtype)


def density_of(raw: Float[Tensor, "p"], factor: float) -> Float[Tensor, "p"]:
    """Return the density (per training unit) for raw outputs: ``factor`` times their exponential."""
    # Matter of a density of exp(15) is opaque within a thousandth of any relevant length.
    return factor * raw.clamp(max=15.0).exp()
