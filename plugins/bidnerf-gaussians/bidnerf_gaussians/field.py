"""Gaussians as a radiance field."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from bidnerf_core.fields import SceneBounds, Splats
from bidnerf_core.settings import Range
from bidnerf_gaussians.gaussians import COEFFICIENTS, Gaussians
from bidnerf_gaussians.pieces import LARGEST_ALPHA, LEAST_ALPHA, Meeting, PieceField
from bidnerf_gaussians.quaternions import matrices, turned_back
from bidnerf_gaussians.spherical_harmonics import colours


@dataclass(frozen=True)
class FieldConfig:
    """Size of the field."""

    gaussians: Annotated[int, Range(1, 2 * 10**8)] = 30_000  # number of Gaussians
    degree: Annotated[int, Range(0, 3)] = 0  # degree of the spherical harmonics of colours
    # composite in the order of the means, as image rasterizers do, instead of the order of the peaks along a
    # ray
    by_means: bool = False


@dataclass(frozen=True, eq=False)
class Peaks(Meeting):
    """Where lines come nearest to Gaussians, in the Gaussians' metric."""

    spread: Float[Tensor, "*p"]  # metres: standard deviation of the Gaussian along the line


class GaussiansField(PieceField):
    """Gaussians, each evaluated at its peak along a ray, nearest first (Moenne-Loccoz et al. 2024).

    Along a ray with origin o and direction d, a Gaussian with precision P and mean m is largest at ``t =
    d'P(m - o) / d'Pd``; its opacity times its value there is alpha. ``hits`` returns these in compositing
    order. Their optical thickness ``-log(1 - alpha)``, distributed along the ray like the Gaussian, is the
    density that ``query`` returns: its integral along a ray gives the same opacity.
    """

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
        self.register_tree(count)
        self.refit()

    @torch.no_grad()
    def refit(self) -> None:
        """Rebuild the tree after the Gaussians have moved."""
        opacity = self.logits.sigmoid()
        seen = opacity >= LEAST_ALPHA
        # Alpha falls to the least opacity at this many standard deviations. A box extends over at least two,
        # so that ``query`` finds nearly all of a Gaussian's density.
        extent = (2 * (opacity / LEAST_ALPHA).clamp(min=1).log()).sqrt().clamp(min=2.0)
        turns = matrices(torch.nn.functional.normalize(self.quaternions, dim=-1))
        spread = (turns.square() * (2 * self.log_scales).exp()[:, None]).sum(-1).sqrt()
        self.rebuild(self.means, extent[:, None] * spread, seen)

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

    def meet(self, index: Int[Tensor, "p"], origins: Float[Tensor, "p 3"], directions: Float[Tensor, "p 3"]) -> Peaks:
        """Return where lines come nearest to the Gaussians with indices ``index``."""
        means, widths, turns, logits = (
            part.index_select(0, index) for part in (self.means, self.log_scales, self.quaternions, self.logits)
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
        key = torch.linalg.vector_norm(away, dim=-1) if self.config.by_means else distance
        return Peaks(distance, alpha.clamp(max=LARGEST_ALPHA), key, speed.rsqrt())

    def colours(
        self, index: Int[Tensor, "p"], meeting: Meeting, directions: Float[Tensor, "p 3"]
    ) -> Float[Tensor, "p 3"]:
        return colours(self.harmonics.index_select(0, index), directions)

    def profile(self, meeting: Peaks) -> Float[Tensor, "p"]:  # type: ignore[override]
        return torch.exp(-0.5 * (meeting.distance / meeting.spread).square()) / (
            math.sqrt(2 * math.pi) * meeting.spread
        )

    def half_length(self, meeting: Peaks) -> Float[Tensor, "p"]:  # type: ignore[override]
        return math.sqrt(math.pi / 2) * meeting.spread
