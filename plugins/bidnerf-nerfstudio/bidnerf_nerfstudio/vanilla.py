"""nerfstudio's vanilla-nerf (Mildenhall et al. 2020): a coarse and a fine network, with hierarchical sampling."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import torch
from jaxtyping import Float
from torch import Generator, Tensor, nn
from torch.nn.functional import softplus

from bidnerf_core.backend import RecipeBackend
from bidnerf_core.devices import constant
from bidnerf_core.fields import (
    FieldValues,
    HierarchicalField,
    Importance,
    RaySampler,
    SceneBounds,
    Stratified,
    device_of,
    encoding_width,
    frequency_encoding,
)
from bidnerf_core.frames import View
from bidnerf_core.settings import Count, Layers, Positive, Range
from bidnerf_core.training import Report, StepOutcome, Supervision, SupervisionConfig
from bidnerf_nerfstudio.networks import Perceptron
from bidnerf_nerfstudio.placement import Placement
from bidnerf_nerfstudio.weights import Weights

POSITION, DIRECTION = 10, 4
"""Frequencies of positions and of directions."""
HIGHEST = {POSITION: 8.0, DIRECTION: 4.0}
"""Octave of the highest frequency; the lowest has one period per unit."""
SKIP = 4
"""Index of the layer that receives the encoded position again."""
PADDING = 0.01
"""Added to the weight of every interval of the coarse network, as in nerfstudio's PDFSampler."""


@dataclass(frozen=True)
class VanillaConfig(SupervisionConfig):
    """Size, sampling and training of both networks."""

    width: Count = 256  # units of a hidden layer
    layers: Layers = 8  # layers before density and colour
    colour_width: Count = 128  # units of a layer of the colour network
    colour_layers: Layers = 2  # layers of the colour network
    coarse_samples: Count = 64  # samples of the coarse network along a ray
    fine_samples: Count = 129  # further samples of the fine network, placed by the coarse one
    # scale, rotation (3x3) and translation from the world to training coordinates; (): the box becomes [-1,
    # 1]
    placement: tuple[float, ...] = ()
    steps: Count = 20000  # steps of the optimizer
    rays_per_step: Count = 512  # rays of a step
    learning_rate: Positive = 5e-4  # initial learning rate
    seed: Annotated[int, Range(0)] = 0  # seed of the initial weights and of all random draws


def encoded(points: Float[Tensor, "p 3"], count: int) -> Float[Tensor, "p f"]:
    """Return the points, and the sines and cosines of their coordinates at ``count`` frequencies."""
    octaves = (HIGHEST[count] * number / (count - 1) for number in range(count))
    frequencies = constant(tuple(2 * math.pi * 2**octave for octave in octaves), points)
    return frequency_encoding(points, frequencies, sines_first=True)


class VanillaNetwork(nn.Module):
    """Density and colour in training coordinates."""

    def __init__(self, config: VanillaConfig) -> None:
        super().__init__()
        inputs, width = encoding_width(POSITION), config.width
        skip = SKIP if config.layers > SKIP else None
        self.base = Perceptron(inputs, width, width, config.layers, skip)
        self.density = nn.Linear(width, 1)
        self.head = Perceptron(
            width + encoding_width(DIRECTION), config.colour_width, config.colour_width, config.colour_layers
        )
        self.colour = nn.Linear(config.colour_width, 3)

    def forward(
        self, positions: Float[Tensor, "p 3"], directions: Float[Tensor, "p 3"]
    ) -> tuple[Float[Tensor, "p"], Float[Tensor, "p 3"]]:
        """Return densities per training unit, and colours."""
        features = self.base(encoded(positions, POSITION)).relu()
        seen = self.head(torch.cat([encoded(directions, DIRECTION), features], dim=-1)).relu()
        return softplus(self.density(features))[:, 0], self.colour(seen).sigmoid()


class VanillaLevel(nn.Module):
    """A network and its sampler, in the world of a map."""

    def __init__(self, config: VanillaConfig, placement: Placement, sampler: RaySampler) -> None:
        super().__init__()
        self.placement, self.sampler = placement, sampler
        self.network = VanillaNetwork(config)

    def query(self, positions: Float[Tensor, "*p 3"], directions: Float[Tensor, "*p 3"]) -> FieldValues:
        """Return density (per unit of the world) and colour."""
        shape = positions.shape[:-1]
        density, rgb = self.network(
            self.placement.points(positions.reshape(-1, 3)),
            self.placement.directions(directions.reshape(-1, 3)),
        )
        return FieldValues((self.placement.scale * density).reshape(shape), rgb.reshape(*shape, 3))


class VanillaField(HierarchicalField):
    """The field of the fine network; ``levels`` are that of the coarse network and this one."""

    def __init__(self, config: VanillaConfig, bounds: SceneBounds) -> None:
        super().__init__()
        self.bounds = bounds
        placement = Placement.of(config.placement, bounds)
        self.coarse = VanillaLevel(config, placement, Stratified(config.coarse_samples))
        self.fine = VanillaLevel(config, placement, Importance(self.coarse, config.fine_samples, PADDING))


def reordered(weight: Float[Tensor, "o i"], count: int, weights: Weights) -> Float[Tensor, "o i"]:
    """Reorder a layer's weights for the order of the encoding here.

    nerfstudio has the sines of all frequencies of x, then of y and z, the cosines likewise, and then the
    point. Columns after those of the encoding are unchanged.
    """
    width = encoding_width(count)
    if weight.dim() != 2 or weight.shape[1] < width:
        raise weights.error(f"a layer is {tuple(weight.shape)}", expected=f"{width} inputs or more")
    waves = torch.arange(2 * 3 * count).reshape(2, 3, count).transpose(1, 2).reshape(-1)
    order = torch.cat([torch.arange(width - 3, width), waves])
    return torch.cat([weight[:, order], weight[:, width:]], dim=-1)


def train(field: VanillaField, views: Sequence[View], config: VanillaConfig, report: Report) -> None:
    """Fit ``field`` to ``views``; see ``fit`` on checkpoints and stopping."""
    supervision = Supervision(views, field.bounds, config, device_of(field))

    def outcome(step: int, generator: Generator) -> StepOutcome:
        return supervision.step(field, config.rays_per_step, generator)

    groups = [{"params": list(field.parameters()), "lr": config.learning_rate}]
    supervision.fit(field, groups, outcome, config.steps, report, seed=config.seed)


backend = RecipeBackend(
    "vanilla-nerf of nerfstudio: imported runs, or trained here",
    VanillaConfig,
    VanillaField,
    train,
    VanillaConfig(
        width=64,
        layers=4,
        colour_width=64,
        coarse_samples=48,
        fine_samples=24,
        steps=2000,
        learning_rate=3e-3,
    ),
)
