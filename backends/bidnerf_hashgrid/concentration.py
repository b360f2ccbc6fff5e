"""A sampler that puts most of its samples where another field has weight."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TypeVar

import torch
from jaxtyping import Float, Int
from torch import Generator, Tensor
from torch.nn.functional import max_pool1d, pad

from bidnerf_core.devices import may_wait
from bidnerf_core.fields import (
    RadianceField,
    Rays,
    RaySamples,
    even_borders,
    gather_valid,
    query_samples,
    rendering_weights,
)

EVEN_SHARE = 0.25
"""Fraction of the borders that ``Concentrated`` spreads evenly, so that matter missing from the guide is found."""
TAIL = 0.005
"""Fraction of a ray's weight, at either end, that ``Concentrated`` leaves to evenly spread intervals."""
LARGEST_THICKNESS = 0.5
"""Optical thickness to which ``Concentrated`` limits the guide's intervals. A coarse guide has a single
density for a cell that is only partly dense; what lies behind the empty part must be found as well."""

OfRays = TypeVar("OfRays", Rays, RaySamples)


def rows_of(of: OfRays, index: Int[Tensor, "n"]) -> OfRays:
    """Return the rays, or the samples of the rays, at these (flattened) indices."""
    shape = of.near.shape if isinstance(of, Rays) else of.starts.shape[:-1]
    parts = (getattr(of, field.name) for field in fields(of))
    flat = (part.reshape(shape.numel(), *part.shape[len(shape) :]) for part in parts)
    return type(of)(*(part.index_select(0, index) for part in flat))


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
    dense = TAIL + (1 - 2 * TAIL) * even_borders(count + 1 - even, laid, jitter)
    by_weight = _interpolate(dense, cdf, laid)
    by_length = even_borders(even, laid, jitter) * laid[..., -1:]
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


def _interpolate(
    at: Float[Tensor, "*r n"], x: Float[Tensor, "*r s"], y: Float[Tensor, "*r s"]
) -> Float[Tensor, "*r n"]:
    """Evaluate at ``at`` the piecewise linear function through the points (x, y), x ascending."""
    right = torch.searchsorted(x.contiguous(), at.contiguous(), right=True).clamp(1, x.shape[-1] - 1)
    x0, x1, y0, y1 = (part.gather(-1, index) for part in (x, y) for index in (right - 1, right))
    slope = (y1 - y0) / (x1 - x0).clamp(min=torch.finfo(x.dtype).tiny)
    return torch.minimum(torch.maximum(y0 + (at - x0) * slope, y0), y1)
