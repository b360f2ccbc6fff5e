"""Where on each ray a field is asked."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Generator, Tensor

from bidnerf_core.field import RadianceField, Rays, RaySamples
from bidnerf_core.rendering import query_samples, rendering_weights


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


@dataclass(frozen=True)
class Importance:
    """Hierarchical sampling (Mildenhall et al. 2020, section 5.2): more intervals where ``field`` puts its weight.

    The field's own intervals are kept as well, so the result has ``count`` more of them; no gradient flows through the
    choice of place.
    """

    field: RadianceField
    count: int

    def __call__(self, rays: Rays, jitter: Generator | None = None) -> RaySamples:
        with torch.no_grad():
            rough = self.field.sampler(rays, jitter)
            weights = rendering_weights(query_samples(self.field, rays, rough).density, rough)
            added = inverse_transform(rough, weights + 1e-5, self.count, jitter)
            borders = torch.cat([rough.starts, rough.ends[..., -1:], added], dim=-1).sort(dim=-1).values
        starts, ends = borders[..., :-1], borders[..., 1:]
        return RaySamples(starts, ends, (rays.far > rays.near)[..., None].expand_as(starts))


def inverse_transform(
    samples: RaySamples, weights: Float[Tensor, "*r s"], count: int, jitter: Generator | None
) -> Float[Tensor, "*r n"]:
    """``count`` distances distributed as ``weights``, piecewise constant over the intervals, by inverting their CDF."""
    cdf = torch.cumsum(weights, dim=-1)
    cdf = cdf / cdf[..., -1:]
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
    return start + (end - start) * ((places - below) / width).clamp(0, 1)
