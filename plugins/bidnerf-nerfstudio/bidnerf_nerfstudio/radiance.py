"""Density and colour of nerfacto and instant-ngp: one network with a hash encoding, and one for the colour."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor, nn

from bidnerf_core.errors import InputError
from bidnerf_core.fields import FieldValues, SceneBounds, spherical_harmonics
from bidnerf_core.settings import Count, Layers, Positive, Settings
from bidnerf_nerfstudio.networks import (
    HashConfig,
    HashNetwork,
    Perceptron,
    density_of,
    unit_cube,
)
from bidnerf_nerfstudio.placement import Placement

HARMONICS = 16


@dataclass(frozen=True)
class RadianceConfig(Settings):
    """Size of the networks, and the placement of the map's world."""

    encoding: HashConfig = field(default_factory=HashConfig)
    geometry_features: Count = 15  # features that the density network passes on to the colour network
    colour_width: Count = 64  # units of a hidden layer of the colour network
    colour_layers: Layers = 3  # layers of weights of the colour network, the last one included
    appearance: int = 32  # length of the appearance code; 0: none
    initial_density: Positive = 0.01  # factor of all densities (nerfstudio's average_init_density)
    # scale, rotation (3x3) and translation from the world to training coordinates; (): the box becomes [-1,
    # 1]
    placement: tuple[float, ...] = ()
    # corners of the scene in training coordinates
    box: tuple[float, float, float, float, float, float] = (-1.0, -1.0, -1.0, 1.0, 1.0, 1.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 <= self.appearance <= 4096:
            raise InputError(f"appearance is {self.appearance}", expected="0 to 4096")


class Radiance(nn.Module):
    """Density and colour in training coordinates, seen with the mean appearance of the training images."""

    def __init__(self, config: RadianceConfig, contracted: bool) -> None:
        super().__init__()
        self.box = SceneBounds(config.box[:3], config.box[3:], 0.0, 1.0, contracted=contracted)
        self.factor = config.initial_density
        self.base = HashNetwork(config.encoding, 1 + config.geometry_features)
        inputs = HARMONICS + config.geometry_features + config.appearance
        self.head = Perceptron(inputs, config.colour_width, 3, config.colour_layers)
        self.appearance = nn.Parameter(torch.zeros(config.appearance))

    def density(self, positions: Float[Tensor, "p 3"]) -> Float[Tensor, "p"]:
        """Return densities per training unit."""
        points, inside = unit_cube(positions, self.box)
        return density_of(self.base(points)[:, 0], self.factor) * inside

    def forward(
        self, positions: Float[Tensor, "p 3"], directions: Float[Tensor, "p 3"]
    ) -> tuple[Float[Tensor, "p"], Float[Tensor, "p 3"]]:
        """Return densities per training unit, and colours."""
        points, inside = unit_cube(positions, self.box)
        raw, features = self.base(points).split(
            [1, self.head.layers[0].in_features - HARMONICS - len(self.appearance)], -1
        )
        # nerfstudio's torch implementation evaluates the harmonics at directions shifted to [0, 1].
        harmonics = spherical_harmonics((directions + 1) / 2, 16)
        code = self.appearance.expand(len(positions), -1)
        rgb = self.head(torch.cat([harmonics, features, code], dim=-1)).sigmoid()
        return density_of(raw[:, 0], self.factor) * inside, rgb


class PlacedRadiance(nn.Module):
    """Networks in the world of a map; subclasses define where rays are sampled."""

    def __init__(self, config: RadianceConfig, bounds: SceneBounds) -> None:
        super().__init__()
        self.config = config
        self.bounds = bounds
        self.placement = Placement.of(config.placement, bounds)
        self.radiance = Radiance(config, bounds.contracted)

    def query(self, positions: Float[Tensor, "*p 3"], directions: Float[Tensor, "*p 3"]) -> FieldValues:
        """Return density (per unit of the world) and colour."""
        shape, at = positions.shape[:-1], self.radiance.appearance
        flat = positions.reshape(-1, 3).to(at.dtype), directions.reshape(-1, 3).to(at.dtype)
        density, rgb = self.radiance(self.placement.points(flat[0]), self.placement.directions(flat[1]))
        return FieldValues((self.placement.scale * density).reshape(shape), rgb.reshape(*shape, 3))
