"""A blurred view of any radiance field."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Generator, Tensor

from bidnerf_core.fields.contract import FieldValues, RadianceField, RaySampler


@dataclass(frozen=True, eq=False)
class Blurred:
    """A field queried at points with random displacements, of standard deviation ``sigma`` metres along each axis.

    In expectation, it is the field convolved with a Gaussian (randomized smoothing, Duchi et al. 2012), at the cost of one
    query. The sampler is the field's own: if it skips empty cells, matter is not blurred into them.
    """

    field: RadianceField
    sigma: float
    generator: Generator

    @property
    def sampler(self) -> RaySampler:
        return self.field.sampler

    def query(self, positions: Float[Tensor, "*p 3"], directions: Float[Tensor, "*p 3"]) -> FieldValues:
        noise = torch.randn(positions.shape, generator=self.generator, device=self.generator.device)
        return self.field.query(positions + self.sigma * noise.to(positions), directions)
