"""A ball whose rendering is known in closed form."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.fields import FieldValues, RaySampler, Stratified


@dataclass(frozen=True, eq=False)
class HomogeneousBall:
    """A ball of constant density and colour. The opacity along a chord is 1 - exp(-density * length)."""

    radius: float  # metres
    density: float  # per metre
    rgb: tuple[float, float, float] = (0.8, 0.3, 0.2)
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)  # metres, world
    sampler: RaySampler = field(default_factory=lambda: Stratified(256))

    def query(self, positions: Float[Tensor, "*p 3"], directions: Float[Tensor, "*p 3"]) -> FieldValues:
        distance = torch.linalg.vector_norm(positions - positions.new_tensor(self.centre), dim=-1)
        density = torch.where(distance <= self.radius, positions.new_tensor(self.density), 0)
        return FieldValues(density, positions.new_tensor(self.rgb).expand(positions.shape))
