"""Radiance fields in closed form, exact everywhere and in any precision: references for tests."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.fields import FieldValues, RadianceField, RaySampler, Stratified
from bidnerf_core.geometry import SE3


@dataclass(frozen=True, eq=False)
class GaussianBlobs:
    """A sum of isotropic Gaussian clouds with smoothly changing colour; infinitely differentiable.

    The field computes in the precision of the positions.
    """

    centres: Float[Tensor, "k 3"]  # metres
    widths: Float[Tensor, " k"]  # standard deviations, metres
    densities: Float[Tensor, " k"]  # at each centre, per metre
    waves: Float[Tensor, "3 3"]  # radians per metre of each colour's change (rows: red, green, blue)
    sampler: RaySampler

    @staticmethod
    def random(count: int = 5, seed: int = 0, samples: int = 64, density: float = 12.0) -> GaussianBlobs:
        """Return ``count`` different blobs within the cube from -1 to 1 (float64)."""
        generator = torch.Generator().manual_seed(seed)
        centres = torch.rand((count, 3), generator=generator, dtype=torch.float64) * 1.3 - 0.65
        widths = 0.12 + 0.13 * torch.rand(count, generator=generator, dtype=torch.float64)
        densities = density * (0.5 + torch.rand(count, generator=generator, dtype=torch.float64))
        waves = 3 * torch.randn((3, 3), generator=generator, dtype=torch.float64)
        return GaussianBlobs(centres, widths, densities, waves, Stratified(samples))

    def query(self, positions: Float[Tensor, "*p 3"], directions: Float[Tensor, "*p 3"]) -> FieldValues:
        squared = (positions[..., None, :] - self.centres.to(positions)).square().sum(-1)
        clouds = self.densities.to(positions) * torch.exp(-0.5 * squared / self.widths.to(positions).square())
        return FieldValues(clouds.sum(-1), 0.5 + 0.45 * torch.sin(positions @ self.waves.to(positions).T + 0.7))


@dataclass(frozen=True, eq=False)
class MovedField:
    """A field expressed in another world frame, so that a test can check that results move with the world."""

    field: RadianceField
    T_new_old: SE3

    @property
    def sampler(self) -> RaySampler:
        return self.field.sampler

    def query(self, positions: Float[Tensor, "*p 3"], directions: Float[Tensor, "*p 3"]) -> FieldValues:
        back = self.T_new_old.inverse().to(dtype=positions.dtype)
        return self.field.query(back.apply(positions), back.rotate(directions))
