"""Samplers, which choose where on each ray a field is queried; fields that wrap others; and a stand-in for a missing field."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any, NoReturn, TypeVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Generator, Tensor, nn
from torch.nn.functional import max_pool1d, pad

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
from bidnerf_core.fields.voxel_grid import OccupancyMask

EVEN_SHARE = 0.25
"""Fraction of the borders that ``Concentrated`` spreads evenly, so that matter missing from the guide is found."""
TAIL = 0.005
"""Fraction of a ray's weight, at either end, that ``Concentrated`` leaves to evenly spread intervals."""
LARGEST_THICKNESS = 0.5
"""Optical thickness to which ``Concentrated`` limits the guide's intervals. A coarse guide has a single
density for a cell that is only partly dense; what lies behind the empty part must be found as well."""


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
        borders = _levels(self.count + 1, near, jitter)
        distances = near + (far - near) * borders
        if spacing is not None:
            distances = spacing.distance(distances)
        valid = (far > near).expand(*rays.near.shape, self.count)
        return RaySamples(distances[..., :-1], distances[..., 1:], valid)


@dataclass(frozen=True)
class OccupiedOnly:
    """A sampler that invalidates the samples of another one in cells that cannot hold matter."""

    occupancy: OccupancyMask
    sampler: RaySampler

    @torch.no_grad()
    def __call__(self, rays: Rays, jitter: Generator | None = None) -> RaySamples:
        samples = self.sampler(rays, jitter)
        return replace(samples, valid=samples.valid & self.occupancy.holds(rays.at(samples.middles)))


OfRays = TypeVar("OfRays", Rays, RaySamples)


def rows_of(of: OfRays, index: Int[Tensor, "n"]) -> OfRays:
    """Return the rays, or the samples of the rays, at these (flattened) indices."""
    shape = of.near.shape if isinstance(of, Rays) else of.starts.shape[:-1]
    parts = (getattr(of, field.name) for field in fields(of))
    flat = (part.reshape(shape.numel(), *part.shape[len(shape) :]) for part in parts)
    return type(of)(*(part.index_select(0, index) for part in flat))


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


@dataclass(frozen=True)
class Concentrated:
    """A sampler of at most ``count`` intervals per ray, short where the weights of the field ``guide`` are large, and long elsewhere.

    Three quarters of the borders divide the guide's weight over its own valid intervals into equal parts; the others
    divide their length. Each new interval has the total length of the pieces that it replaces. A ray with ``count``
    intervals or fewer keeps them. No gradient flows through the choice.
    """

    guide: RadianceField
    count: int

    @torch.no_grad()
    def __call__(self, rays: Rays, jitter: Generator | None = None) -> RaySamples:
        rough = gather_valid(self.guide.sampler(rays, jitter))
        if rough.starts.shape[-1] <= self.count:
            return rough
        many = rough.valid.sum(-1) > self.count
        # What the other rays keep: ``gathered`` puts the valid intervals first.
        unchanged = [part[..., : self.count] for part in rough.parts]
        # Selecting the rays in ``many`` makes the host wait for the device. Where it may not, all rays are concentrated.
        if not may_wait(many.device):
            samples = self._concentrate(rays, rough, jitter)
            pairs = zip(samples.parts, unchanged, strict=True)
            return RaySamples(*(torch.where(many[..., None], new, old) for new, old in pairs))
        index = many.reshape(-1).nonzero()[:, 0]
        samples = self._concentrate(rows_of(rays, index), rows_of(rough, index), jitter)
        merged = (
            old.reshape(-1, self.count).index_copy(0, index, new)
            for new, old in zip(samples.parts, unchanged, strict=True)
        )
        return RaySamples(*merged).unflattened(many.shape)

    def _concentrate(self, rays: Rays, rough: RaySamples, jitter: Generator | None) -> RaySamples:
        length = (rough.ends - rough.starts).clamp(min=torch.finfo(rough.ends.dtype).tiny)
        density = torch.minimum(query_samples(self.guide, rays, rough).density, LARGEST_THICKNESS / length)
        return concentrate(rough, rendering_weights(density, rough), self.count, jitter)


def concentrate(
    samples: RaySamples, weights: Float[Tensor, "*r s"], count: int, jitter: Generator | None
) -> RaySamples:
    """Resample rays to ``count`` intervals that are short where the ``weights`` of ``samples`` are large, see ``Concentrated``."""
    length = torch.where(samples.valid, samples.ends - samples.starts, 0)
    laid = pad(length.cumsum(-1), (1, 0))  # borders of the intervals, laid end to end
    # Borders by equal weight and by equal length, in the coordinate of the concatenated intervals.
    blurred = max_pool1d(weights.reshape(-1, 1, weights.shape[-1]), 3, stride=1, padding=1).view_as(weights)
    mass = torch.where(length > 0, blurred, 0) + 1e-5 * length / laid[..., -1:].clamp(min=1e-30)
    cdf = pad(mass.cumsum(-1) / mass.sum(-1, keepdim=True).clamp(min=1e-30), (1, 0))
    even = max(2, round(EVEN_SHARE * (count + 1)))
    dense = TAIL + (1 - 2 * TAIL) * _levels(count + 1 - even, laid, jitter)
    by_weight = _interpolate(dense, cdf, laid)
    by_length = _levels(even, laid, jitter) * laid[..., -1:]
    border = torch.cat([by_weight, by_length], dim=-1).sort(dim=-1).values
    middle, half = (border[..., 1:] + border[..., :-1]) / 2, border.diff(dim=-1) / 2
    owner = torch.searchsorted(laid[..., 1:].contiguous(), middle.contiguous()).clamp(max=length.shape[-1] - 1)
    at = samples.starts.gather(-1, owner) + (middle - laid.gather(-1, owner))
    starts, ends = at - half, at + half
    # Neither rounding nor an interval that spans a gap may make two intervals overlap.
    between = (ends[..., :-1] + starts[..., 1:]) / 2
    starts = torch.cat([starts[..., :1], torch.maximum(starts[..., 1:], between)], dim=-1)
    ends = torch.cat([torch.minimum(ends[..., :-1], between), ends[..., -1:]], dim=-1)
    return RaySamples(starts, torch.maximum(starts, ends), (half > 0) & samples.valid.any(-1, keepdim=True))


def _levels(count: int, like: Float[Tensor, "*r b"], jitter: Generator | None) -> Float[Tensor, "*r n"]:
    """Return ``count`` evenly spaced numbers from 0 to 1; with jitter, the inner ones are shifted by up to half a step."""
    levels = torch.linspace(0, 1, count, dtype=like.dtype, device=like.device).repeat(*like.shape[:-1], 1)
    if jitter is not None and count > 2:
        shift = torch.rand((*like.shape[:-1], count - 2), generator=jitter, device=jitter.device) - 0.5
        levels[..., 1:-1] += shift.to(levels) / (count - 1)
    return levels


def _interpolate(
    at: Float[Tensor, "*r n"], x: Float[Tensor, "*r s"], y: Float[Tensor, "*r s"]
) -> Float[Tensor, "*r n"]:
    """Evaluate at ``at`` the piecewise linear function through the points (x, y), x ascending."""
    right = torch.searchsorted(x.contiguous(), at.contiguous(), right=True).clamp(1, x.shape[-1] - 1)
    x0, x1, y0, y1 = (part.gather(-1, index) for part in (x, y) for index in (right - 1, right))
    slope = (y1 - y0) / (x1 - x0).clamp(min=torch.finfo(x.dtype).tiny)
    return torch.minimum(torch.maximum(y0 + (at - x0) * slope, y0), y1)


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
        return ScaledSampler(self.trained.sampler, self.scale)

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
        trained: HitField = self.trained
        hits = trained.hits(shrunk(rays, self.scale))
        return replace(hits, distance=hits.distance * self.scale)


class ScaledSplatField(ScaledHitField):
    """A scaled field that consists of discrete primitives."""

    def splats(self) -> Splats:
        """Return the primitives in the scaled world."""
        trained: SplatField = self.trained
        splats = trained.splats()
        return replace(splats, positions=splats.positions * self.scale, radius=splats.radius * self.scale)


def scale_field(field: RadianceField, scale: float) -> ScaledField:
    """Return a field in a world that is ``scale`` times as large; it has the same optional interfaces as ``field``."""
    if isinstance(field, HitField) and isinstance(field, SplatField):
        return ScaledSplatField(field, scale)
    return (ScaledHitField if isinstance(field, HitField) else ScaledField)(field, scale)


def shrunk(rays: Rays, scale: float) -> Rays:
    """Convert rays from a world scaled by ``scale`` to the world of the wrapped field."""
    return Rays(rays.origins / scale, rays.directions, rays.near / scale, rays.far / scale)


@dataclass(frozen=True)
class ScaledSampler:
    """Wraps a sampler for rays in a world that is ``scale`` times as large as that of the wrapped sampler."""

    sampler: RaySampler
    scale: float

    def __call__(self, rays: Rays, jitter: Generator | None = None) -> RaySamples:
        """Return the samples of rays in the scaled world."""
        samples = self.sampler(shrunk(rays, self.scale), jitter)
        return replace(samples, starts=samples.starts * self.scale, ends=samples.ends * self.scale)


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
