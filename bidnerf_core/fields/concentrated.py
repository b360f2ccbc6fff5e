"""Samples that are concentrated where a coarse field has its weight, of a limited number per ray."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float, Int
from torch import Generator, Tensor
from torch.nn.functional import max_pool1d, pad

from bidnerf_core.devices import may_wait
from bidnerf_core.fields.contract import RadianceField, Rays, RaySampler, RaySamples
from bidnerf_core.fields.rendering import query_samples, rendering_weights
from bidnerf_core.fields.sampling import either, gathered, rows_of

EVEN_SHARE = 0.25
"""Fraction of the borders that ``Concentrated`` spreads evenly, so that matter which the guide lacks is found."""
TAIL = 0.005
"""Fraction of a ray's weight, at either end, that ``Concentrated`` leaves to evenly spread intervals."""
LARGEST_THICKNESS = 0.5
"""Optical thickness to which ``Concentrated`` limits the guide's intervals. A coarse guide has one density for a cell of
which only a part is dense; what lies behind the other part must be found as well."""


@runtime_checkable
class SplittingSampler(RaySampler, Protocol):
    """A sampler that returns rays with many intervals apart, so that short rows are not padded to the length of long ones."""

    def split_by_count(
        self, rays: Rays, count: int, jitter: Generator | None = None
    ) -> tuple[RaySamples, Int[Tensor, "m"], RaySamples]:
        """Return the samples of all rays, the (flattened) indices of rays with more than ``count``, and the samples of these.

        The intervals are those of ``__call__`` with the same ``jitter``. In the first part, rows are at most ``count`` long,
        and what they hold for the rays with more has no meaning. Called only where the host may wait for the device.
        """
        ...


def _split(
    sampler: RaySampler, rays: Rays, count: int, jitter: Generator | None
) -> tuple[RaySamples, Int[Tensor, "m"], RaySamples]:
    """Return any sampler's intervals, gathered, as a ``SplittingSampler`` does."""
    if isinstance(sampler, SplittingSampler):
        few, many, rest = sampler.split_by_count(rays, count, jitter)
        return gathered(few), many, gathered(rest)
    rough = gathered(sampler(rays, jitter))
    many = (rough.valid.sum(-1) > count).reshape(-1).nonzero()[:, 0]
    return _first(rough, count), many, rows_of(rough, many)


@dataclass(frozen=True)
class Concentrated:
    """At most ``count`` intervals of each ray, short where the field ``guide`` has its weight and long elsewhere.

    Three quarters of the borders divide the guide's weight over its own valid intervals into equal parts; the others divide
    their length. Each interval is as long as what it replaces. A ray with ``count`` intervals or fewer keeps them. No gradient
    flows through the choice.
    """

    guide: RadianceField
    count: int

    @torch.no_grad()
    def __call__(self, rays: Rays, jitter: Generator | None = None) -> RaySamples:
        if not may_wait(rays.near.device):
            return self._of_known_shape(rays, jitter)
        few, many, rough = _split(self.guide.sampler, rays, self.count, jitter)
        if not len(many):
            return few
        found = self._concentrated(rows_of(rays, many), rough, jitter)
        merged = (
            pad(old, (0, self.count - old.shape[-1])).reshape(-1, self.count).index_copy(0, many, new)
            for old, new in zip(few.parts, found.parts, strict=True)
        )
        return RaySamples(*merged).unflattened(rays.near.shape)

    def _of_known_shape(self, rays: Rays, jitter: Generator | None) -> RaySamples:
        """Return the intervals without waiting for the device: all rays are concentrated, also those that keep theirs."""
        rough = gathered(self.guide.sampler(rays, jitter))
        if rough.starts.shape[-1] <= self.count:
            return rough
        few = rough.valid.sum(-1) <= self.count
        return either(few, _first(rough, self.count), self._concentrated(rays, rough, jitter))

    def _concentrated(self, rays: Rays, rough: RaySamples, jitter: Generator | None) -> RaySamples:
        length = (rough.ends - rough.starts).clamp(min=torch.finfo(rough.ends.dtype).tiny)
        density = torch.minimum(query_samples(self.guide, rays, rough).density, LARGEST_THICKNESS / length)
        return concentrated(rough, rendering_weights(density, rough), self.count, jitter)


def _first(samples: RaySamples, count: int) -> RaySamples:
    """Return the first ``count`` intervals of each ray."""
    return RaySamples(*(part[..., :count] for part in samples.parts))


def concentrated(
    samples: RaySamples, weights: Float[Tensor, "*r s"], count: int, jitter: Generator | None
) -> RaySamples:
    """Return ``count`` intervals in place of ``samples``, short where ``weights`` are large, see ``Concentrated``."""
    length = torch.where(samples.valid, samples.ends - samples.starts, 0)
    laid = pad(length.cumsum(-1), (1, 0))  # borders of the intervals, laid end to end
    border = _borders(weights, length, laid, count, jitter)
    middle, half = (border[..., 1:] + border[..., :-1]) / 2, border.diff(dim=-1) / 2
    owner = torch.searchsorted(laid[..., 1:].contiguous(), middle.contiguous()).clamp(
        max=length.shape[-1] - 1
    )
    at = samples.starts.gather(-1, owner) + (middle - laid.gather(-1, owner))
    starts, ends = at - half, at + half
    # Neither rounding nor an interval that spans a gap may make two of them overlap.
    between = (ends[..., :-1] + starts[..., 1:]) / 2
    starts = torch.cat([starts[..., :1], torch.maximum(starts[..., 1:], between)], dim=-1)
    ends = torch.cat([torch.minimum(ends[..., :-1], between), ends[..., -1:]], dim=-1)
    return RaySamples(starts, torch.maximum(starts, ends), (half > 0) & samples.valid.any(-1, keepdim=True))


def _borders(
    weights: Float[Tensor, "*r s"], length: Float[Tensor, "*r s"], laid: Float[Tensor, "*r b"], count: int,
    jitter: Generator | None,
) -> Float[Tensor, "*r n"]:  # fmt: skip
    """Return ``count + 1`` borders, by equal weight and by equal length, in the coordinate of the concatenated intervals."""
    blurred = max_pool1d(weights.reshape(-1, 1, weights.shape[-1]), 3, stride=1, padding=1).view_as(weights)
    mass = torch.where(length > 0, blurred, 0) + 1e-5 * length / laid[..., -1:].clamp(min=1e-30)
    cdf = pad(mass.cumsum(-1) / mass.sum(-1, keepdim=True).clamp(min=1e-30), (1, 0))
    even = max(2, round(EVEN_SHARE * (count + 1)))
    dense = TAIL + (1 - 2 * TAIL) * _levels(count + 1 - even, laid, jitter)
    by_weight = _interpolated(dense, cdf, laid)
    by_length = _levels(even, laid, jitter) * laid[..., -1:]
    return torch.cat([by_weight, by_length], dim=-1).sort(dim=-1).values


def _levels(count: int, like: Float[Tensor, "*r b"], jitter: Generator | None) -> Float[Tensor, "*r n"]:
    """Return ``count`` numbers from 0 to 1 in equal steps; with jitter, the inner ones are shifted by up to half a step."""
    levels = torch.linspace(0, 1, count, dtype=like.dtype, device=like.device).repeat(*like.shape[:-1], 1)
    if jitter is not None and count > 2:
        shift = torch.rand((*like.shape[:-1], count - 2), generator=jitter, device=jitter.device) - 0.5
        levels[..., 1:-1] += shift.to(levels) / (count - 1)
    return levels


def _interpolated(
    at: Float[Tensor, "*r n"], x: Float[Tensor, "*r s"], y: Float[Tensor, "*r s"]
) -> Float[Tensor, "*r n"]:
    """Return the piecewise linear function through the points (x, y), x ascending, at ``at``."""
    right = torch.searchsorted(x.contiguous(), at.contiguous(), right=True).clamp(1, x.shape[-1] - 1)
    x0, x1, y0, y1 = (part.gather(-1, index) for part in (x, y) for index in (right - 1, right))
    slope = (y1 - y0) / (x1 - x0).clamp(min=torch.finfo(x.dtype).tiny)
    return torch.minimum(torch.maximum(y0 + (at - x0) * slope, y0), y1)
