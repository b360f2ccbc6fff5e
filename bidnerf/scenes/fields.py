"""Radiance fields in closed form, exact everywhere and in any precision: references for tests."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.fields import FieldValues, RaySampler, Stratified
from bidnerf_core.geometry import SE3


@dataclass(frozen=True, eq=False)
class GaussianBlobs:
    """A sum of isotropic Gaussian clouds with smoothly changing colour; infinitely differentiable.

    The field computes in the precision of the positions. ``moved`` moves the whole scene, so that a test can check that
    results move with the world.
    """

    centres: Float[Tensor, "k 3"]  # metres, frame of the field
    widths: Float[Tensor, " k"]  # standard deviations, metres
    densities: Float[Tensor, " k"]  # at each centre, per metre
    waves: Float[Tensor, "3 3"]  # radians per metre of each colour's change (rows: red, green, blue)
    T_world_field: SE3
    sampler: RaySampler

    @staticmethod
    def random(count: int = 5, seed: int = 0, samples: int = 64, density: float = 12.0) -> GaussianBlobs:
        """Return ``count`` different blobs within the cube from -1 to 1 (float64)."""
        generator = torch.Generator().manual_seed(seed)
        centres = torch.rand((count, 3), generator=generator, dtype=torch.float64) * 1.3 - 0.65
        widths = 0.12 + 0.13 * torch.rand(count, generator=generator, dtype=torch.float64)
        densities = density * (0.5 + torch.rand(count, generator=generator, dtype=torch.float64))
        waves = 3 * torch.randn((3, 3), generator=generator, dtype=torch.float64)
        return GaussianBlobs(centres, widths, densities, waves, SE3.identity(), Stratified(samples))

    def query(self, positions: Float[Tensor, "*p 3"], directions: Float[Tensor, "*p 3"]) -> FieldValues:
        local = self.T_world_field.to(positions).inverse().apply(positions)
        squared = (local[..., None, :] - self.centres.to(local)).square().sum(-1)
        clouds = self.densities.to(local) * torch.exp(-0.5 * squared / self.widths.to(local).square())
        return FieldValues(clouds.sum(-1), 0.5 + 0.45 * torch.sin(local @ self.waves.to(local).T + 0.7))

    def moved(self, T_new_world: SE3) -> GaussianBlobs:
        """Return the field whose values at ``T_new_world.apply(p)`` are those of this field at ``p``."""
        return replace(self, T_world_field=T_new_world.to(self.T_world_field.rotation) @ self.T_world_field)


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
