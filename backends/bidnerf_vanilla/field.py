"""The radiance field of NeRF (Mildenhall et al. 2020): two networks, the second sampled where the first finds matter."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from bidnerf_core.fields.contract import FieldValues, RaySampler, SceneBounds
from bidnerf_core.fields.sampling import Importance, OccupiedOnly, Stratified
from bidnerf_core.fields.voxel_grid import OccupancyMask, VoxelGrid
from bidnerf_core.settings import Count, Range
from bidnerf_vanilla.network import NerfNetwork, NetworkConfig

SHARPNESS = 30.0
"""Density per side of the scene at a raw density of about 1, so that networks with small outputs can represent surfaces."""
THINNESS = 1.0
"""Shift of raw density that makes an untrained field nearly transparent (Barron et al. 2021, mip-NeRF)."""


@dataclass(frozen=True)
class FieldConfig(NetworkConfig):
    """Size of the field."""

    coarse_samples: Count = 64  # intervals of a ray at which the coarse network is evaluated
    fine_samples: Count = 32  # further intervals of the fine network, placed by the coarse one
    # cells along the longest side of the scene; those that views show to be empty are skipped
    room_resolution: Annotated[int, Range(2, 1024)] = 64


class Level(nn.Module):
    """A network and its sampler."""

    def __init__(self, config: NetworkConfig, bounds: SceneBounds, sampler: RaySampler) -> None:
        super().__init__()
        self.sampler = sampler
        self.bounds = bounds
        self.network = NerfNetwork(config)

    def query(self, positions: Float[Tensor, "*p 3"], directions: Float[Tensor, "*p 3"]) -> FieldValues:
        """Return the values; positions are scaled to the cube [-1, 1], so that the unit of length has no effect."""
        shape = positions.shape[:-1]
        points = self.bounds.normalized(positions.reshape(-1, 3))
        raw, rgb = self.network(points, directions.reshape(-1, 3))
        density = functional.softplus(raw - THINNESS) * (SHARPNESS / self.bounds.side)
        return FieldValues(density.reshape(shape), rgb.reshape(*shape, 3))


class VanillaField(nn.Module):
    """The fine level, with the coarse one in ``levels``; its sampler is hierarchical and uses the coarse one (section 5.2)."""

    def __init__(self, config: FieldConfig, bounds: SceneBounds) -> None:
        super().__init__()
        self.config = config
        self.bounds = bounds
        self.side = bounds.side
        self.room = OccupancyMask(VoxelGrid.cube(bounds, config.room_resolution))
        self.coarse = Level(
            config, bounds, OccupiedOnly(self.room, Stratified(config.coarse_samples, bounds))
        )
        self.fine = Level(
            config, bounds, OccupiedOnly(self.room, Importance(self.coarse, config.fine_samples))
        )

    @property
    def sampler(self) -> RaySampler:
        return self.fine.sampler

    @property
    def levels(self) -> tuple[Level, VanillaField]:
        return self.coarse, self

    def query(self, positions: Float[Tensor, "*p 3"], directions: Float[Tensor, "*p 3"]) -> FieldValues:
        return self.fine.query(positions, directions)
