"""Samplers: where on each ray a field is queried."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Generator, Tensor
from torch.nn.functional import pad

from bidnerf_core.field import FieldValues, RadianceField, Rays, RaySampler, RaySamples
from bidnerf_core.rendering import query_samples, rendering_weights
from bidnerf_core.voxel_grid import OccupancyMask


@dataclass(frozen=True)
class Stratified:
    """``count`` equal intervals of [near, far]; with jitter, their borders move at random within half an interval."""

    count: int

    def __call__(self, rays: Rays, jitter: Generator | None = None) -> RaySamples:
        near, far = rays.near.detach()[..., None], rays.far.detach()[..., None]
        borders = torch.linspace(0, 1, self.count + 1, dtype=near.dtype, device=near.device)
        borders = borders.expand(*rays.near.shape, -1)
        if jitter is not None:
            shift = (
                torch.rand((*rays.near.shape, self.count - 1), generator=jitter, device=jitter.device) - 0.5
            )
            inner = borders[..., 1:-1] + shift.to(near) / self.count
            borders = torch.cat([borders[..., :1], inner, borders[..., -1:]], dim=-1)
        distances = near + (far - near) * borders
        valid = (far > near).expand(*rays.near.shape, self.count)
        return RaySamples(distances[..., :-1], distances[..., 1:], valid)


@dataclass(frozen=True, eq=False)
class AroundDepth:
    """``count`` equal intervals within ``reach`` metres of the distance that was measured along each ray.

    With a nearly correct pose they hold all the matter that the ray meets, with a wrong one they are empty. Rays without a
    measurement (distance 0) are sampled by ``otherwise``.
    """

    distance: Float[Tensor, "*r"]  # metres along the rays that are to be sampled
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
        return _either(measured, Stratified(self.count)(window, jitter), self.otherwise(rest, jitter))


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


def _either(which: Bool[Tensor, "*r"], yes: RaySamples, no: RaySamples) -> RaySamples:
    """Return the samples ``yes`` for some rays and ``no`` for the others, padded to a common number a ray."""
    width = max(yes.starts.shape[-1], no.starts.shape[-1])

    def filled(part: Tensor) -> Tensor:
        return pad(part, (0, width - part.shape[-1]))

    pairs = ((yes.starts, no.starts), (yes.ends, no.ends), (yes.valid, no.valid))
    return RaySamples(*(torch.where(which[..., None], filled(a), filled(b)) for a, b in pairs))


@dataclass(frozen=True)
class Importance:
    """Hierarchical sampling (Mildenhall et al. 2020, section 5.2): more intervals where ``field`` has its weight.

    The field's own valid intervals are cut at ``count`` more places; what its sampler leaves out, as an occupancy grid does,
    stays out. No gradient flows through the choice of places.
    """

    field: RadianceField
    count: int

    def __call__(self, rays: Rays, jitter: Generator | None = None) -> RaySamples:
        with torch.no_grad():
            rough = _gathered(self.field.sampler(rays, jitter))
            if rough.starts.shape[-1] == 0:
                return rough
            weights = rendering_weights(query_samples(self.field, rays, rough).density, rough)
            weights = torch.where(rough.valid, weights + 1e-5, 0)
            return _cut(rough, *inverse_transform(rough, weights, self.count, jitter))


def inverse_transform(
    samples: RaySamples, weights: Float[Tensor, "*r s"], count: int, jitter: Generator | None
) -> tuple[Float[Tensor, "*r n"], Int[Tensor, "*r n"]]:
    """Return ``count`` distances distributed as ``weights`` (piecewise constant over the intervals), by inverting their CDF.

    They come in ascending order, with the interval in which each lies. A ray without weight has them in its first interval.
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


def _gathered(samples: RaySamples) -> RaySamples:
    """Return the samples with valid intervals first, and without the overlaps that rounding makes."""
    order = (~samples.valid).sort(dim=-1, stable=True).indices
    starts, ends, valid = (part.gather(-1, order) for part in (samples.starts, samples.ends, samples.valid))
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
