"""A field in a world scaled relative to the one it was trained in."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from jaxtyping import Float
from torch import Generator, Tensor, nn

from bidnerf_core.fields.contract import (
    FieldValues,
    HitField,
    RadianceField,
    RayHits,
    Rays,
    RaySampler,
    RaySamples,
    SplatField,
    Splats,
    levels,
)


class ScaledField(nn.Module):
    """A field whose world is ``scale`` times as large as that of the wrapped field; colours stay, and
    densities are per new length.
    """

    def __init__(self, field: RadianceField, scale: float) -> None:
        super().__init__()
        self.trained: Any = field
        self.scale = scale

    @property
    def sampler(self) -> RaySampler:
        """The sampler of the field, for rays in the scaled world."""
        return ScaledSampler(self.trained.sampler, self.scale)

    @property
    def levels(self) -> tuple[RadianceField, ...]:
        """The levels of detail of the field, coarsest first; the last one is this field."""
        return (*(scaled_field(level, self.scale) for level in levels(self.trained)[:-1]), self)

    def query(self, positions: Float[Tensor, "*p 3"], directions: Float[Tensor, "*p 3"]) -> FieldValues:
        """Return density and colour at ``positions`` in the scaled world."""
        found = self.trained.query(positions / self.scale, directions)
        return replace(found, density=found.density / self.scale)


class ScaledHitField(ScaledField):
    """A scaled field that computes the hits of whole rays."""

    def hits(self, rays: Rays) -> RayHits:
        """Return the hits of rays in the scaled world."""
        trained: HitField = self.trained
        found = trained.hits(shrunk(rays, self.scale))
        return replace(found, distance=found.distance * self.scale)


class ScaledSplatField(ScaledHitField):
    """A scaled field that consists of pieces."""

    def splats(self) -> Splats:
        """Return the pieces in the scaled world."""
        trained: SplatField = self.trained
        found = trained.splats()
        return replace(found, positions=found.positions * self.scale, radius=found.radius * self.scale)


def scaled_field(field: RadianceField, scale: float) -> ScaledField:
    """Return a field in a world that is ``scale`` times as large; it has the same optional parts as ``field``."""
    if isinstance(field, HitField) and isinstance(field, SplatField):
        return ScaledSplatField(field, scale)
    return (ScaledHitField if isinstance(field, HitField) else ScaledField)(field, scale)


def shrunk(rays: Rays, scale: float) -> Rays:
    """Convert rays of a scaled world to the world of the field."""
    return Rays(rays.origins / scale, rays.directions, rays.near / scale, rays.far / scale)


@dataclass(frozen=True)
class ScaledSampler:
    """A sampler for rays in a world that is ``scale`` times as large."""

    sampler: RaySampler
    scale: float

    def __call__(self, rays: Rays, jitter: Generator | None = None) -> RaySamples:
        """Return the samples of rays in the scaled world."""
        found = self.sampler(shrunk(rays, self.scale), jitter)
        return replace(found, starts=found.starts * self.scale, ends=found.ends * self.scale)


def trained_field(field: RadianceField) -> RadianceField:
    """Return the field as its backend built it, in the unit of its training; its weights are the ones stored."""
    return field.trained if isinstance(field, ScaledField) else field
