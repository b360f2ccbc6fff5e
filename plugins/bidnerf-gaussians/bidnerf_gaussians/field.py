"""Gaussians as a radiance field."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import torch
from jaxtyping import Bool, Float, Int
from torch import Generator, Tensor, nn

from bidnerf_core.fields import (
    FieldValues,
    Meeting,
    RayHits,
    Rays,
    RaySamples,
    SceneBounds,
    Splats,
    flattened,
    level_sizes,
    listed,
    met_pieces,
    pieces_about,
    tree_of,
    values_of_pieces,
)
from bidnerf_core.settings import Range
from bidnerf_gaussians.gaussians import COEFFICIENTS, LEAST_OPACITY, Gaussians
from bidnerf_gaussians.quaternions import matrices, turned_back
from bidnerf_gaussians.spherical_harmonics import colours

LARGEST_ALPHA = 0.999
"""Largest opacity of one Gaussian along a ray, as in gsplat."""
LEAST_EXTENT = 2.0
"""Minimum extent of a Gaussian's box in standard deviations, so that ``query`` finds nearly all of its density."""


@dataclass(frozen=True)
class FieldConfig:
    """Size of the field."""

    gaussians: Annotated[int, Range(1, 2 * 10**8)] = 30_000  # number of Gaussians
    degree: Annotated[int, Range(0, 3)] = 0  # degree of the spherical harmonics of colours
    # composite in the order of the means, as image rasterizers do, instead of the order of the peaks along a
    # ray
    by_means: bool = False


@dataclass(frozen=True, eq=False)
class _Peaks:
    """Where lines come nearest to Gaussians, in the Gaussians' metric, and what is seen there."""

    distance: Float[Tensor, "*p"]  # metres from the line's origin; may be negative
    mean: Float[Tensor, "*p"]  # metres: distance of the mean from the line's origin
    alpha: Float[Tensor, "*p"]
    spread: Float[Tensor, "*p"]  # metres: standard deviation of the Gaussian along the line


class GaussiansField(nn.Module):
    """Gaussians, each evaluated at its peak along a ray, nearest first, as in 3D Gaussian ray tracing
    (Moenne-Loccoz et al. 2024).

    Along a ray with origin o and direction d, a Gaussian with precision P and mean m is largest at ``t =
    d'P(m - o) / d'Pd``; its opacity times its value there is alpha. ``hits`` returns these in compositing
    order. Their optical thickness ``-log(1 - alpha)``, distributed along the ray like the Gaussian, is the
    density that ``query`` returns: its integral along a ray gives the same opacity.
    """

    order: Tensor

    def __init__(self, config: FieldConfig, bounds: SceneBounds) -> None:
        super().__init__()
        self.config, self.bounds = config, bounds
        count = config.gaussians
        lower, size = torch.tensor(bounds.lower), torch.tensor(bounds.size)
        width = math.log(0.5 * bounds.side / max(2.0, count ** (1 / 2)))
        self.means = nn.Parameter(lower + size * torch.rand(count, 3))
        self.log_scales = nn.Parameter(torch.full((count, 3), width))
        self.quaternions = nn.Parameter(torch.nn.functional.normalize(torch.randn(count, 4), dim=-1))
        self.logits = nn.Parameter(torch.full((count,), -2.0))
        self.harmonics = nn.Parameter(0.5 * torch.randn(count, COEFFICIENTS[config.degree], 3))
        self.register_buffer("order", torch.arange(count))
        for number, nodes in enumerate(level_sizes(count)):
            self.register_buffer(f"boxes_{number}", torch.zeros(6, nodes, 8))
        self.refit()

    @property
    def boxes(self) -> list[Float[Tensor, "6 _ 8"]]:
        """The boxes of the tree, the lowest level first, see ``index``."""
        return [getattr(self, f"boxes_{number}") for number in range(len(level_sizes(len(self.means))))]

    @torch.no_grad()
    def refit(self) -> None:
        """Rebuild the tree after the Gaussians have moved."""
        opacity = self.logits.sigmoid()
        seen = opacity >= LEAST_OPACITY
        # alpha falls to the least opacity at this many standard deviations
        extent = (2 * (opacity / LEAST_OPACITY).clamp(min=1).log()).sqrt().clamp(min=LEAST_EXTENT)
        turns = matrices(torch.nn.functional.normalize(self.quaternions, dim=-1))
        spread = (turns.square() * (2 * self.log_scales).exp()[:, None]).sum(-1).sqrt()
        order, levels = tree_of(self.means, extent[:, None] * spread, seen)
        self.order.copy_(order)
        for boxes, found in zip(self.boxes, levels, strict=True):
            boxes.copy_(found)

    @torch.no_grad()
    def assign(self, gaussians: Gaussians) -> None:
        """Copy the parameters of the same number of Gaussians of the same degree."""
        for name in ("means", "log_scales", "quaternions", "logits", "harmonics"):
            getattr(self, name).copy_(getattr(gaussians, name))
        self.refit()

    def gaussians(self) -> Gaussians:
        """Return the Gaussians, on the CPU."""
        names = ("means", "log_scales", "quaternions", "logits", "harmonics")
        return Gaussians(*(getattr(self, name).detach().cpu().float() for name in names))

    @torch.no_grad()
    def splats(self) -> Splats:
        """Return the Gaussians as points, in the colours of the first harmonic, which is their mean."""
        means = self.means.detach()
        rgb = colours(self.harmonics.detach()[:, :1], means)
        return Splats(means, rgb, self.logits.detach().sigmoid(), self.log_scales.detach().mean(-1).exp())

    @property
    def sampler(self) -> PeakSampler:
        """The sampler that places an interval around each peak."""
        return PeakSampler(self)

    def hits(self, rays: Rays) -> RayHits:
        """Return the peaks along rays with colour and alpha; differentiable in the rays and the parameters."""
        shape = rays.near.shape
        flat = flattened(rays)
        gaussian, valid = self.met(flat, self.config.by_means)
        width = gaussian.shape[1]
        place, ray, index = listed(gaussian, valid)
        directions = flat.directions.index_select(0, ray)
        peaks = self._peaks(index, flat.origins.index_select(0, ray), directions)
        rgb = colours(self.harmonics.index_select(0, index), directions)
        parts = []
        for value in (peaks.distance, peaks.alpha, rgb):
            whole = value.new_zeros((valid.numel(), *value.shape[1:]))
            parts.append(whole.index_copy(0, place, value).reshape(*shape, width, *value.shape[1:]))
        valid = valid.reshape(*shape, width)
        alpha = torch.where(valid, parts[1], 0)
        return RayHits(torch.where(valid, parts[0], flat.near.reshape(*shape, 1)), alpha, parts[2], valid)

    @torch.no_grad()
    def met(self, rays: Rays, by_means: bool) -> tuple[Int[Tensor, "r s"], Bool[Tensor, "r s"]]:
        """Return the indices of the Gaussians that rays (r) hit, nearest first, until the transmittance is
        negligible.

        With ``by_means``, they are ordered by the distance of the mean, otherwise by that of the peak.
        """

        def meet(index: Tensor, origins: Tensor, directions: Tensor) -> Meeting:
            peaks = self._peaks(index, origins, directions)
            alpha = torch.where(peaks.alpha >= LEAST_OPACITY, peaks.alpha, 0)
            return Meeting(peaks.distance, alpha, peaks.mean if by_means else peaks.distance)

        return met_pieces(rays, self.boxes, self.order, meet)

    def query(self, positions: Float[Tensor, "*p 3"], directions: Float[Tensor, "*p 3"]) -> FieldValues:
        """Return the density whose integral along ``directions`` gives the opacity of ``hits``, and the mean colour."""
        return values_of_pieces(positions, directions, self._about)

    def _about(
        self, positions: Float[Tensor, "p 3"], directions: Float[Tensor, "p 3"]
    ) -> tuple[Int[Tensor, "q"], Float[Tensor, "q"], Float[Tensor, "q 3"]]:
        """Return the pairs of a point and a nearby piece, with density and colour."""
        point, index, counts = pieces_about(positions, self.boxes, self.order)
        towards = directions.index_select(0, point)
        peaks = self._peaks(index, positions.index_select(0, point), towards)
        thickness = torch.where(counts & (peaks.alpha >= LEAST_OPACITY), -torch.log1p(-peaks.alpha), 0)
        profile = torch.exp(-0.5 * (peaks.distance / peaks.spread).square()) / (
            math.sqrt(2 * math.pi) * peaks.spread
        )
        density = thickness * profile
        rgb = colours(self.harmonics.index_select(0, index), towards)
        return point, density, rgb

    def _peaks(
        self, index: Int[Tensor, "p"], origins: Float[Tensor, "p 3"], directions: Float[Tensor, "p 3"]
    ) -> _Peaks:
        """Return where lines come nearest to the Gaussians with indices ``index``."""
        means, widths, turns, logits = (
            part.index_select(0, index)
            for part in (self.means, self.log_scales, self.quaternions, self.logits)
        )
        turns = turns * turns.square().sum(-1, keepdim=True).clamp(min=1e-24).rsqrt()
        # Relative to the point nearest to the mean, so that rounding is that of lengths around the Gaussian.
        away = means - origins
        along = (away * directions).sum(-1, keepdim=True)
        narrow = (-widths).exp()
        u = turned_back(turns, along * directions - away) * narrow
        v = turned_back(turns, directions) * narrow
        speed = v.square().sum(-1).clamp(min=1e-30)
        square = torch.linalg.cross(u, v).square().sum(-1) / speed  # of the distance, in standard deviations
        alpha = logits.sigmoid() * torch.exp(-0.5 * square)
        distance = along[:, 0] - (u * v).sum(-1) / speed
        return _Peaks(
            distance, torch.linalg.vector_norm(away, dim=-1), alpha.clamp(max=LARGEST_ALPHA), speed.rsqrt()
        )


@dataclass(frozen=True, eq=False)
class PeakSampler:
    """An interval around each Gaussian that a ray hits, as long as its density there divided by its peak.

    For an isolated Gaussian, density times length is its optical thickness; if several overlap, their
    intervals end half-way between their peaks. ``hits`` is exact, and is what the core renders.
    """

    field: GaussiansField

    @torch.no_grad()
    def __call__(self, rays: Rays, jitter: Generator | None = None) -> RaySamples:
        shape, flat = rays.near.shape, flattened(rays)
        gaussian, valid = self.field.met(flat, by_means=False)
        width = gaussian.shape[1]
        ray = torch.arange(len(gaussian), device=gaussian.device)[:, None].expand(gaussian.shape).reshape(-1)
        peaks = self.field._peaks(
            gaussian.reshape(-1), flat.origins.index_select(0, ray), flat.directions.index_select(0, ray)
        )
        middle, half = (
            part.reshape(gaussian.shape) for part in (peaks.distance, math.sqrt(math.pi / 2) * peaks.spread)
        )
        near, far = flat.near[:, None], torch.maximum(flat.near, flat.far)[:, None]
        starts = torch.where(valid, torch.maximum(middle - half, near), far)
        ends = torch.where(valid, torch.minimum(middle + half, far), far)
        if width > 1:
            place = torch.where(valid, middle, torch.inf)
            between = (place[:, 1:] + place[:, :-1]) / 2
            starts[:, 1:] = torch.maximum(starts[:, 1:], torch.where(valid[:, 1:], between, far))
            ends[:, :-1] = torch.where(valid[:, 1:], torch.minimum(ends[:, :-1], between), ends[:, :-1])
        ends = torch.maximum(starts, ends)
        return RaySamples(*(part.reshape(*shape, width) for part in (starts, ends, valid)))
