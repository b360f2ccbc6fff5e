"""Two networks of nerf-pytorch as one radiance field."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from bidnerf_core.fields import (
    FieldValues,
    HierarchicalField,
    Importance,
    RaySampler,
    SceneBounds,
    Stratified,
)
from bidnerf_core.settings import Count
from bidnerf_nerf_pytorch.network import Network, NetworkConfig


@dataclass(frozen=True)
class FieldConfig(NetworkConfig):
    """Architecture of both networks, and the number of their samples."""

    coarse_samples: Count = 64  # samples of the coarse network along a ray
    fine_samples: Count = 64  # further samples of the fine network, placed by the coarse one


class Level(nn.Module):
    """A network and its sampler. Positions are in the world it was trained in, and are not scaled."""

    def __init__(self, config: NetworkConfig, sampler: RaySampler) -> None:
        super().__init__()
        self.sampler = sampler
        self.network = Network(config)

    def query(self, positions: Float[Tensor, "*p 3"], directions: Float[Tensor, "*p 3"]) -> FieldValues:
        shape = positions.shape[:-1]
        density, rgb = self.network(positions.reshape(-1, 3), directions.reshape(-1, 3))
        return FieldValues(density.relu().reshape(shape), torch.sigmoid(rgb).reshape(*shape, 3))


class NerfPytorchField(HierarchicalField):
    """The field of the fine network; ``levels`` are that of the coarse network and this one."""

    def __init__(self, config: FieldConfig, bounds: SceneBounds) -> None:
        super().__init__()
        self.config = config
        self.bounds = bounds
        self.coarse = Level(config, Stratified(config.coarse_samples))
        self.fine = Level(config, Importance(self.coarse, config.fine_samples))
