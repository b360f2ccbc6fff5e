"""Bins (equal parts of a ray's segment in the scene's box), and the selection of a few bins per ray."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Generator, Tensor

from bidnerf_adanerf.networks import Oracle
from bidnerf_core.fields import Rays, RaySamples, SceneBounds, Stratified


@dataclass(frozen=True)
class Bins:
    """A ``RaySampler`` that returns all bins of each ray, as dense training needs them.

    The bins divide the part of the ray that lies in the box, whatever the ray's [near, far]; each bin is then
    clipped to [near, far].
    """

    bounds: SceneBounds
    count: int

    @torch.no_grad()
    def __call__(self, rays: Rays, jitter: Generator | None = None) -> RaySamples:
        whole = Stratified(self.count, self.bounds)(self.through(rays), jitter)
        near, far = rays.near[..., None], rays.far[..., None]
        starts, ends = (torch.minimum(torch.maximum(x, near), far) for x in (whole.starts, whole.ends))
        return RaySamples(starts, ends, whole.valid & (starts < ends))

    @torch.no_grad()
    def through(self, rays: Rays) -> Rays:
        """Return the rays with [near, far] set by the box alone."""
        return self.bounds.rays(rays.origins.detach(), rays.directions.detach())


@dataclass(frozen=True)
class Sparse:
    """A ``RaySampler`` that keeps only the bins that the oracle scores highest.

    Each ray keeps at most ``most`` of the bins whose score exceeds ``threshold``, ordered from near to far, and at least
    one bin if it meets the scene. The choice carries no gradient; the derivative with respect to the pose comes from the
    positions of the chosen bins.
    """

    oracle: Oracle
    bins: Bins
    threshold: float
    most: int

    @torch.no_grad()
    def __call__(self, rays: Rays, jitter: Generator | None = None) -> RaySamples:
        whole = self.bins(rays, jitter)
        scores = torch.where(whole.valid, ray_logits(self.oracle, self.bins, rays).sigmoid().to(whole.starts), -1.0)
        return choose_samples(whole, scores, self.threshold, self.most)


def ray_logits(oracle: Oracle, bins: Bins, rays: Rays) -> Float[Tensor, "*r n"]:
    """Return the oracle's score for each bin of each ray, as logits; differentiable in the oracle's parameters."""
    shape = rays.near.shape
    whole = bins.through(rays)
    spacing = bins.bounds.spacing(whole)
    near, far = spacing.coordinate(torch.stack([whole.near, whole.far], dim=-1)).split(1, dim=-1)
    along = spacing.distance(torch.lerp(near, far, oracle.places.to(near)))
    points = bins.bounds.normalized(whole.at(along)).reshape(shape.numel(), len(oracle.places), 3)
    logits: Tensor = oracle(points.to(oracle.places))
    return logits.reshape(*shape, logits.shape[-1])


def choose_samples(samples: RaySamples, scores: Float[Tensor, "*r n"], threshold: float, most: int) -> RaySamples:
    """Return, for each ray, up to ``most`` samples with the highest scores above ``threshold``.

    The best sample of a ray is kept even below the threshold, provided that it is valid.
    """
    count = scores.shape[-1]
    best, index = scores.topk(min(most, count), dim=-1)
    taken: Bool[Tensor, "*r k"] = best > threshold
    taken[..., 0] = best[..., 0] >= 0
    index = index.masked_fill(~taken, count).sort(dim=-1).values  # nearest first, unused ones last
    valid, index = index < count, index.clamp(max=count - 1)
    return RaySamples(samples.starts.gather(-1, index), samples.ends.gather(-1, index), valid)
