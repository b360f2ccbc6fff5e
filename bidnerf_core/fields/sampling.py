"""Samplers: where on each ray a field is queried."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import TypeVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Generator, Tensor
from torch.nn.functional import pad

from bidnerf_core.devices import may_wait
from bidnerf_core.fields.contract import FieldValues, RadianceField, Rays, RaySampler, RaySamples, SceneBounds
from bidnerf_core.fields.rendering import query_samples, rendering_weights
from bidnerf_core.fields.voxel_grid import OccupancyMask


@dataclass(frozen=True)
class Stratified:
    """``count`` intervals of [near, far]; with jitter, their borders are shifted randomly by up to half an interval.

    They are equally long in the coordinate of ``SceneBounds.spacing`` or, without bounds, in distance.
    """

    count: int
    bounds: SceneBounds | None = None

    def __call__(self, rays: Rays, jitter: Generator | None = None) -> RaySamples:
        limits = torch.stack([rays.near.detach(), rays.far.detach()], dim=-1)
        spacing = None if self.bounds is None else self.bounds.spacing(rays)
        near, far = (limits if spacing is None else spacing.place(limits)).split(1, dim=-1)
        borders = torch.linspace(0, 1, self.count + 1, dtype=near.dtype, device=near.device)
        borders = borders.expand(*rays.near.shape, -1)
        if jitter is not None:
            shift = (
                torch.rand((*rays.near.shape, self.count - 1), generator=jitter, device=jitter.device) - 0.5
            )
            inner = borders[..., 1:-1] + shift.to(near) / self.count
            borders = torch.cat([borders[..., :1], inner, borders[..., -1:]], dim=-1)
        distances = near + (far - near) * borders
        if spacing is not None:
            distances = spacing.distance(distances)
        valid = (far > near).expand(*rays.near.shape, self.count)
        return RaySamples(distances[..., :-1], distances[..., 1:], valid)


@dataclass(frozen=True, eq=False)
class AroundDepth:
    """``count`` equal intervals within ``reach`` metres of the distance measured along each ray.

    With a nearly correct pose they contain all the matter that the ray meets; with a wrong one they are empty. Rays without
    a measurement (distance 0) are sampled by ``otherwise``.
    """

    distance: Float[Tensor, "*r"]  # metres along the rays to be sampled
    reach: float
    count: int
    otherwise: RaySampler

    def __call__(self, rays: Rays, jitter: Generator | None = None) -> RaySamples:
        measured = self.distance > 0
        near = torch.maximum(rays.near, self.distance - self.reach)
        far = torch.minimum(rays.far, self.distance + self.reach)
        window = replace(rays, near=near, far=torch.maximum(near, far))
        rest = replace(
            rays, far=torch.where(measured, rays.near, rays.far)
        )  # empty where a distance was measured
        return either(measured, Stratified(self.count)(window, jitter), self.otherwise(rest, jitter))


@dataclass(frozen=True)
class OccupiedOnly:
    """The samples of another sampler, valid only in cells that may hold matter."""

    occupancy: OccupancyMask
    sampler: RaySampler

    @torch.no_grad()
    def __call__(self, rays: Rays, jitter: Generator | None = None) -> RaySamples:
        samples = self.sampler(rays, jitter)
        return replace(samples, valid=samples.valid & self.occupancy.holds(rays.at(samples.middles)))


@dataclass(frozen=True)
class Resampled:
    """A field with another sampler in place of its own."""

    field: RadianceField
    sampler: RaySampler

    def query(self, positions: Float[Tensor, "*p 3"], directions: Float[Tensor, "*p 3"]) -> FieldValues:
        return self.field.query(positions, directions)


OfRays = TypeVar("OfRays", Rays, RaySamples)


def rows_of(of: OfRays, index: Int[Tensor, "n"]) -> OfRays:
    """Return the rays, or the samples of the rays, at these (flattened) indices."""
    shape = of.near.shape if isinstance(of, Rays) else of.starts.shape[:-1]
    parts = (getattr(of, field.name) for field in fields(of))
    flat = (part.reshape(shape.numel(), *part.shape[len(shape) :]) for part in parts)
    return type(of)(*(part.index_select(0, index) for part in flat))


def either(which: Bool[Tensor, "*r"], yes: RaySamples, no: RaySamples) -> RaySamples:
    """Return the samples ``yes`` for the rays of ``which`` and ``no`` for the others, padded to a common number per ray."""
    width = max(yes.starts.shape[-1], no.starts.shape[-1])

    def filled(part: Tensor) -> Tensor:
        return pad(part, (0, width - part.shape[-1]))

    pairs = ((yes.starts, no.starts), (yes.ends, no.ends), (yes.valid, no.valid))
    return RaySamples(*(torch.where(which[..., None], filled(a), filled(b)) for a, b in pairs))


@dataclass(frozen=True)
class Importance:
    """Hierarchical sampling (Mildenhall et al. 2020, section 5.2): more intervals where ``field`` has its weight.

    The field's own valid intervals are cut at ``count`` more places; what its sampler skips, as an occupancy grid does,
    remains skipped. No gradient flows through the choice of places.
    """

    field: RadianceField
    count: int

    def __call__(self, rays: Rays, jitter: Generator | None = None) -> RaySamples:
        with torch.no_grad():
            rough = gathered(self.field.sampler(rays, jitter))
            if rough.starts.shape[-1] == 0:
                return rough
            weights = rendering_weights(query_samples(self.field, rays, rough).density, rough)
            weights = torch.where(rough.valid, weights + 1e-5, 0)
            return _cut(rough, *inverse_transform(rough, weights, self.count, jitter))


def inverse_transform(
    samples: RaySamples, weights: Float[Tensor, "*r s"], count: int, jitter: Generator | None
) -> tuple[Float[Tensor, "*r n"], Int[Tensor, "*r n"]]:
    """Return ``count`` distances distributed as ``weights`` (piecewise constant over the intervals), by inverting their CDF.

    They are in ascending order, each with the index of its interval. On a ray without weight, all are in its first interval.
    """
    cdf = torch.cumsum(weights, dim=-1)
    cdf = cdf / cdf[..., -1:].clamp(min=torch.finfo(cdf.dtype).tiny)
    places = (torch.arange(count, dtype=cdf.dtype, device=cdf.device) + 0.5) / count
    places = places.expand(*cdf.shape[:-1], count).contiguous()
    if jitter is not None:
        places = (
            places
            + (torch.rand(places.shape, generator=jitter, device=jitter.device).to(places) - 0.5) / count
        )
    index = torch.searchsorted(cdf, places).clamp(max=cdf.shape[-1] - 1)
    below = torch.cat([torch.zeros_like(cdf[..., :1]), cdf], dim=-1).gather(-1, index)
    width = (cdf.gather(-1, index) - below).clamp(min=torch.finfo(cdf.dtype).tiny)
    start, end = samples.starts.gather(-1, index), samples.ends.gather(-1, index)
    distances = start + (end - start) * ((places - below) / width).clamp(0, 1)
    return torch.minimum(distances, end), index


def gathered(samples: RaySamples) -> RaySamples:
    """Return the samples with valid intervals first, and without overlaps from rounding."""
    starts, ends, valid = samples.parts
    # Sorting costs more than all the rest; most samplers return the valid intervals first.
    if not (may_wait(valid.device) and bool((valid[..., 1:] <= valid[..., :-1]).all())):
        order = (~valid).sort(dim=-1, stable=True).indices
        starts, ends, valid = (part.gather(-1, order) for part in (starts, ends, valid))
    following = torch.where(valid, starts, torch.inf)[..., 1:]
    following = torch.cat([following, torch.full_like(ends[..., :1], torch.inf)], dim=-1)
    return RaySamples(starts, torch.maximum(starts, torch.minimum(ends, following)), valid)


def _cut(rough: RaySamples, places: Float[Tensor, "*r n"], owner: Int[Tensor, "*r n"]) -> RaySamples:
    """Return the gathered intervals ``rough``, cut at ``places``, which lie in the intervals ``owner``.

    A piece begins at the start of an interval or at a place in it, and ends at the next place or at the interval's end.
    """
    first = torch.arange(rough.starts.shape[-1], device=owner.device).expand(rough.starts.shape)
    owner = torch.cat([owner, first], dim=-1)
    valid = rough.valid.gather(-1, owner)
    # Places go first: where a place and a start coincide, the piece from the start is the longer one.
    starts, order = (
        torch.cat([places, rough.starts], dim=-1).where(valid, torch.inf).sort(dim=-1, stable=True)
    )
    owner, valid = owner.gather(-1, order), valid.gather(-1, order)
    following = torch.cat([starts[..., 1:], torch.full_like(starts[..., :1], torch.inf)], dim=-1)
    ends = torch.minimum(rough.ends.gather(-1, owner), following)
    last = rough.ends.amax(-1, keepdim=True)  # a finite number for invalid samples
    return RaySamples(starts.where(valid, last), ends.where(valid, last), valid)
