"""Sampling with proposal networks: densities of small networks, one after the other, place the samples of a ray."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Generator, Tensor

from bidnerf_core.fields import Rays, RaySamples, inverse_transform, rendering_weights

PADDING = 0.01
"""Added to the weight of every interval before the next ones are placed, as in nerfstudio's PDFSampler."""

Density = Callable[[Float[Tensor, "p 3"]], Float[Tensor, "p"]]
Spacing = Literal["piecewise", "uniform"]


@dataclass(frozen=True, eq=False)
class Proposed:
    """The intervals at which a proposal network was evaluated, and its result."""

    borders: Float[Tensor, "*r s+1"]  # in the coordinate of the spacing
    weights: Float[Tensor, "*r s"]


@dataclass(frozen=True, eq=False)
class ProposalSampler:
    """Samples of rays in training coordinates: nerfstudio's ProposalNetworkSampler, at inference.

    The first network is evaluated at uniform steps of ``spacing``. The samples of each further network, and of the
    field, are drawn from the rendering weights of the previous one, as a piecewise-constant PDF.
    """

    densities: Sequence[Density]
    counts: Sequence[int]  # samples of each network
    count: int  # samples of the field
    spacing: Spacing

    def __call__(self, rays: Rays, jitter: Generator | None = None) -> RaySamples:
        """Return the samples of the field."""
        with torch.no_grad():
            return self.samples(rays, self.proposed(rays, jitter)[0])

    def samples(self, rays: Rays, borders: Float[Tensor, "*r s"]) -> RaySamples:
        """Return the intervals between borders in the coordinate of the spacing."""
        distances = distance(borders, self.spacing)
        valid = (rays.far > rays.near)[..., None].expand_as(borders[..., 1:])
        return RaySamples(distances[..., :-1], distances[..., 1:], valid)

    def proposed(self, rays: Rays, jitter: Generator | None) -> tuple[Float[Tensor, "*r n"], list[Proposed]]:
        """Return the borders of the field's intervals, and what each network proposed; gradients flow to its weights."""
        limits = torch.stack([rays.near, rays.far], dim=-1).detach()
        near, far = place(limits, self.spacing).split(1, dim=-1)
        borders = near + (far - near) * _even(self.counts[0], rays, jitter)
        found = []
        for density, count in zip(self.densities, (*self.counts[1:], self.count), strict=True):
            samples = self.samples(rays, borders)
            positions = rays.at(samples.middles)
            values = density(positions.reshape(-1, 3)).reshape(positions.shape[:-1])
            weights = rendering_weights(values, samples)
            found.append(Proposed(borders, weights))
            steps = RaySamples(borders[..., :-1], borders[..., 1:], samples.valid)
            borders, _ = inverse_transform(steps, weights.detach() + PADDING, count + 1, jitter)
        return borders, found


def _even(count: int, rays: Rays, jitter: Generator | None) -> Float[Tensor, "*r s"]:
    """Return borders from 0 to 1; with jitter, the inner ones are shifted by up to half a step."""
    even = torch.linspace(0, 1, count + 1, dtype=rays.near.dtype, device=rays.near.device)
    even = even.expand(*rays.near.shape, -1)
    if jitter is None:
        return even
    shift = torch.rand((*rays.near.shape, count - 1), generator=jitter, device=jitter.device) - 0.5
    return torch.cat([even[..., :1], even[..., 1:-1] + shift.to(even) / count, even[..., -1:]], dim=-1)


def place(distances: Tensor, spacing: Spacing) -> Tensor:
    """Return the coordinate at distances (training units): half of them below 1, uniform in their inverse beyond."""
    if spacing == "uniform":
        return distances
    return torch.where(distances < 1, distances / 2, 1 - 1 / (2 * distances.clamp(min=1)))


def distance(places: Tensor, spacing: Spacing) -> Tensor:
    """Return the distance (training units) at coordinates, the inverse of ``place``."""
    if spacing == "uniform":
        return places
    return torch.where(places < 0.5, 2 * places, 1 / (2 - 2 * places.clamp(0.5, 1 - 1e-7)))


def interlevel_loss(
    borders: Float[Tensor, "*r n"], weights: Float[Tensor, "*r m"], proposed: Proposed
) -> Float[Tensor, ""]:
    """Return how much the field's weights exceed what a proposal allows (Barron et al. 2022, eq. 13)."""
    total = torch.cat([torch.zeros_like(proposed.weights[..., :1]), proposed.weights.cumsum(-1)], dim=-1)
    known = proposed.borders.contiguous()
    first = torch.searchsorted(known, borders[..., :-1].contiguous(), right=True).sub(1)
    last = torch.searchsorted(known, borders[..., 1:].contiguous())
    first, last = (index.clamp(0, known.shape[-1] - 1) for index in (first, last))
    allowed = total.gather(-1, last) - total.gather(-1, first)
    target = weights.detach()
    return ((target - allowed).clamp(min=0).square() / (target + 1e-7)).sum(-1).mean()
