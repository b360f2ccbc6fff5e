"""Samplers, which choose where on each ray a field is queried; fields that wrap others; and a stand-in for a missing field."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NoReturn

import torch
from jaxtyping import Bool, Float, Int
from torch import Generator, Tensor, nn

from bidnerf_core.devices import may_wait
from bidnerf_core.errors import InputError
from bidnerf_core.fields.contract import (
    FieldDerivatives,
    FieldValues,
    HitField,
    RadianceField,
    RayHits,
    Rays,
    RaySampler,
    RaySamples,
    SceneBounds,
    SplatField,
    Splats,
    derivatives_of,
    levels,
)
from bidnerf_core.fields.rendering import query_samples, rendering_weights


@dataclass(frozen=True)
class Stratified:
    """A sampler of ``count`` intervals of [near, far]; jitter shifts their inner borders by up to half an interval.

    The intervals have equal length in the coordinate of ``SceneBounds.spacing`` or, without bounds, in distance.
    """

    count: int
    bounds: SceneBounds | None = None

    def __call__(self, rays: Rays, jitter: Generator | None = None) -> RaySamples:
        limits = torch.stack([rays.near.detach(), rays.far.detach()], dim=-1)
        spacing = None if self.bounds is None else self.bounds.spacing(rays)
        near, far = (limits if spacing is None else spacing.coordinate(limits)).split(1, dim=-1)
        distances = near + (far - near) * even_borders(self.count + 1, near, jitter)
        if spacing is not None:
            distances = spacing.distance(distances)
        valid = (far > near).expand(*rays.near.shape, self.count)
        return RaySamples(distances[..., :-1], distances[..., 1:], valid)


@dataclass(frozen=True)
class Importance:
    """A hierarchical sampler (Mildenhall et al. 2020, section 5.2): more intervals where the weights of ``field`` are large.

    The field's own valid intervals are split at ``count`` further distances; space that its sampler skips,
    such as one with an occupancy grid, remains skipped. No gradient flows through the choice of distances.
    """

    field: RadianceField
    count: int
    padding: float = 1e-5  # added to the weight of each interval, so that every interval gets some samples

    def __call__(self, rays: Rays, jitter: Generator | None = None) -> RaySamples:
        with torch.no_grad():
            rough = gather_valid(self.field.sampler(rays, jitter))
            if rough.starts.shape[-1] == 0:
                return rough
            weights = rendering_weights(query_samples(self.field, rays, rough).density, rough)
            weights = torch.where(rough.valid, weights + self.padding, 0)
            return _cut(rough, *inverse_transform(rough, weights, self.count, jitter))


def inverse_transform(
    samples: RaySamples, weights: Float[Tensor, "*r s"], count: int, jitter: Generator | None
) -> tuple[Float[Tensor, "*r n"], Int[Tensor, "*r n"]]:
    """Return ``count`` distances along each ray by inverse transform sampling, and the index of the interval of each.

    ``weights`` is the piecewise-constant PDF over the intervals. The distances are in ascending order. On a ray without weight, all
    distances lie in the first interval.
    """
    cdf = torch.cumsum(weights, dim=-1)
    cdf = cdf / cdf[..., -1:].clamp(min=torch.finfo(cdf.dtype).tiny)
    quantiles = (torch.arange(count, dtype=cdf.dtype, device=cdf.device) + 0.5) / count
    quantiles = quantiles.expand(*cdf.shape[:-1], count).contiguous()
    if jitter is not None:
        quantiles = (
            quantiles
            + (torch.rand(quantiles.shape, generator=jitter, device=jitter.device).to(quantiles) - 0.5) / count
        )
    index = torch.searchsorted(cdf, quantiles).clamp(max=cdf.shape[-1] - 1)
    below = torch.cat([torch.zeros_like(cdf[..., :1]), cdf], dim=-1).gather(-1, index)
    width = (cdf.gather(-1, index) - below).clamp(min=torch.finfo(cdf.dtype).tiny)
    start, end = samples.starts.gather(-1, index), samples.ends.gather(-1, index)
    distances = start + (end - start) * ((quantiles - below) / width).clamp(0, 1)
    return torch.minimum(distances, end), index


def gather_valid(samples: RaySamples) -> RaySamples:
    """Return the samples with valid intervals first, and without overlaps from rounding."""
    starts, ends, valid = samples.parts
    # Sorting costs more than everything else; most samplers return the valid intervals first.
    if not (may_wait(valid.device) and bool((valid[..., 1:] <= valid[..., :-1]).all())):
        order = (~valid).sort(dim=-1, stable=True).indices
        starts, ends, valid = (part.gather(-1, order) for part in (starts, ends, valid))
    following = torch.where(valid, starts, torch.inf)[..., 1:]
    following = torch.cat([following, torch.full_like(ends[..., :1], torch.inf)], dim=-1)
    return RaySamples(starts, torch.maximum(starts, torch.minimum(ends, following)), valid)


def _cut(rough: RaySamples, distances: Float[Tensor, "*r n"], owner: Int[Tensor, "*r n"]) -> RaySamples:
    """Return the gathered intervals ``rough``, split at ``places``, which lie in the intervals ``owner``.

    A part begins at the start of an interval or at a place inside the interval, and ends at the next place or at
    the interval's end.
    """
    first = torch.arange(rough.starts.shape[-1], device=owner.device).expand(rough.starts.shape)
    owner = torch.cat([owner, first], dim=-1)
    valid = rough.valid.gather(-1, owner)
    # Places go first: if a place and a start coincide, the piece from the start is the longer one.
    starts, order = torch.cat([distances, rough.starts], dim=-1).where(valid, torch.inf).sort(dim=-1, stable=True)
    owner, valid = owner.gather(-1, order), valid.gather(-1, order)
    following = torch.cat([starts[..., 1:], torch.full_like(starts[..., :1], torch.inf)], dim=-1)
    ends = torch.minimum(rough.ends.gather(-1, owner), following)
    last = rough.ends.amax(-1, keepdim=True)  # a finite number for invalid samples
    return RaySamples(starts.where(valid, last), ends.where(valid, last), valid)


class HierarchicalField(nn.Module):
    """A field with two levels; the coarse one places the samples of the fine one. Subclasses create both."""

    coarse: RadianceField
    fine: RadianceField

    @property
    def sampler(self) -> RaySampler:
        return self.fine.sampler

    @property
    def levels(self) -> tuple[RadianceField, RadianceField]:
        """The levels, the coarse one first."""
        return self.coarse, self

    def query(self, positions: Float[Tensor, "*p 3"], directions: Float[Tensor, "*p 3"]) -> FieldValues:
        return self.fine.query(positions, directions)


def even_borders(count: int, like: Float[Tensor, "*r b"], jitter: Generator | None) -> Float[Tensor, "*r n"]:
    """Return ``count`` evenly spaced numbers from 0 to 1; with jitter, the inner ones are shifted by up to half a step."""
    levels = torch.linspace(0, 1, count, dtype=like.dtype, device=like.device).repeat(*like.shape[:-1], 1)
    if jitter is not None and count > 2:
        shift = torch.rand((*like.shape[:-1], count - 2), generator=jitter, device=jitter.device) - 0.5
        levels[..., 1:-1] += shift.to(levels) / (count - 1)
    return levels


class ScaledField(nn.Module):
    """A field whose world is ``scale`` times as large as that of the wrapped field.

    Colours stay the same; densities are per unit of the new length.
    """

    def __init__(self, field: RadianceField, scale: float) -> None:
        super().__init__()
        self.trained: Any = field
        self.scale = scale

    @property
    def sampler(self) -> RaySampler:
        """The sampler of the field, for rays in the scaled world."""
        return partial(_sample_scaled, self.trained.sampler, self.scale)

    @property
    def levels(self) -> tuple[RadianceField, ...]:
        """The levels of detail of the field, coarsest first; the last one is this field."""
        return (*(scale_field(level, self.scale) for level in levels(self.trained)[:-1]), self)

    def query(self, positions: Float[Tensor, "*p 3"], directions: Float[Tensor, "*p 3"]) -> FieldValues:
        """Return density and colour at ``positions`` in the scaled world."""
        values = self.trained.query(positions / self.scale, directions)
        return replace(values, density=values.density / self.scale)

    def jacobian(
        self, positions: Float[Tensor, "p 3"], directions: Float[Tensor, "p 3"], wanted: Bool[Tensor, "p"] | None = None
    ) -> FieldDerivatives:
        derivatives = derivatives_of(self.trained, positions / self.scale, directions, wanted)
        unit = positions.new_full((4, 1), 1.0)
        unit[0] /= self.scale
        values = replace(derivatives.values, density=derivatives.values.density / self.scale)
        return FieldDerivatives(values, derivatives.by_position * unit / self.scale, derivatives.by_direction * unit)


class ScaledHitField(ScaledField):
    """A scaled field that computes the hits of whole rays."""

    def hits(self, rays: Rays) -> RayHits:
        """Return the hits of rays in the scaled world."""
        hits = self.trained.hits(shrunk(rays, self.scale))
        return replace(hits, distance=hits.distance * self.scale)


class ScaledSplatField(ScaledHitField):
    """A scaled field that consists of discrete primitives."""

    def splats(self) -> Splats:
        """Return the primitives in the scaled world."""
        splats = self.trained.splats()
        return replace(splats, positions=splats.positions * self.scale, radius=splats.radius * self.scale)


def scale_field(field: RadianceField, scale: float) -> ScaledField:
    """Return a field in a world that is ``scale`` times as large; it has the same optional interfaces as ``field``."""
    if isinstance(field, HitField) and isinstance(field, SplatField):
        return ScaledSplatField(field, scale)
    return (ScaledHitField if isinstance(field, HitField) else ScaledField)(field, scale)


def shrunk(rays: Rays, scale: float) -> Rays:
    """Convert rays from a world scaled by ``scale`` to the world of the wrapped field."""
    return Rays(rays.origins / scale, rays.directions, rays.near / scale, rays.far / scale)


def _sample_scaled(sampler: RaySampler, scale: float, rays: Rays, jitter: Generator | None = None) -> RaySamples:
    """Return the samples of rays in a world that is ``scale`` times as large as that of ``sampler``."""
    samples = sampler(shrunk(rays, scale), jitter)
    return replace(samples, starts=samples.starts * scale, ends=samples.ends * scale)


def trained_field(field: RadianceField) -> RadianceField:
    """Return the field as its backend built it, in the length unit of training. Its weights are those that maps store."""
    return field.trained if isinstance(field, ScaledField) else field


class NoField(nn.Module):
    """The field of a landmark-only map. Sampling or querying it raises ``InputError``, whose message states how to add one."""

    def sampler(self, *_: object) -> NoReturn:
        raise InputError("the map has no radiance field, which this needs; 'bidnerf train DATA --out MAP' adds one")

    query = sampler


def has_field(field: RadianceField) -> bool:
    """Return whether ``field`` is a real field rather than ``NoField``."""
    return not isinstance(trained_field(field), NoField)
