"""The radiance field of NeRF (Mildenhall et al. 2020): two networks, of which the second is sampled where the first finds matter."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import torch
from jaxtyping import Float
from torch import Generator, Tensor, nn

from bidnerf_core.fields import (
    FieldValues,
    HierarchicalField,
    Importance,
    OccupancyMask,
    Rays,
    RaySampler,
    RaySamples,
    SceneBounds,
    Stratified,
    VoxelGrid,
    query_network,
)
from bidnerf_core.settings import Count, Range
from bidnerf_vanilla.network import NerfNetwork, NetworkConfig


@dataclass(frozen=True)
class FieldConfig(NetworkConfig):
    """Size of the field."""

    coarse_samples: Count = 64  # intervals of a ray at which the coarse network is evaluated
    fine_samples: Count = 32  # further intervals of the fine network, placed by the coarse one
    # cells along the longest side of the scene; those that views show to be empty are skipped
    room_resolution: Annotated[int, Range(2, 1024)] = 64


@dataclass(frozen=True)
class OccupiedOnly:
    """A sampler that invalidates the samples of another one in cells that cannot hold matter."""

    occupancy: OccupancyMask
    sampler: RaySampler

    @torch.no_grad()
    def __call__(self, rays: Rays, jitter: Generator | None = None) -> RaySamples:
        samples = self.sampler(rays, jitter)
        return replace(samples, valid=samples.valid & self.occupancy.holds(rays.at(samples.middles)))


class Level(nn.Module):
    """One level of the field: a network and its sampler."""

    def __init__(self, config: NetworkConfig, bounds: SceneBounds, sampler: RaySampler) -> None:
        super().__init__()
        self.sampler = sampler
        self.bounds = bounds
        self.network = NerfNetwork(config)

    def query(self, positions: Float[Tensor, "*p 3"], directions: Float[Tensor, "*p 3"]) -> FieldValues:
        return query_network(self.network, self.bounds, positions, directions)


class VanillaField(HierarchicalField):
    """The field of NeRF, whose coarse level places the samples of the fine level (section 5.2); both are in ``levels``."""

    def __init__(self, config: FieldConfig, bounds: SceneBounds) -> None:
        super().__init__()
        self.config = config
        self.bounds = bounds
        self.side = bounds.side
        self.room = OccupancyMask(VoxelGrid.cube(bounds, config.room_resolution))
        self.coarse = Level(config, bounds, OccupiedOnly(self.room, Stratified(config.coarse_samples, bounds)))
        self.fine = Level(config, bounds, OccupiedOnly(self.room, Importance(self.coarse, config.fine_samples)))
