"""A field with its sampler replaced by another."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from bidnerf_core.fields import FieldValues, RadianceField, RaySampler


@dataclass(frozen=True)
class Resampled:
    """The values of ``field`` at the samples of ``sampler``."""

    field: RadianceField
    sampler: RaySampler

    def query(self, positions: Tensor, directions: Tensor) -> FieldValues:
        return self.field.query(positions, directions)
