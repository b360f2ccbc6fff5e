"""Residuals between renderings and measurements, which the first-order methods minimize.

A ``Residual`` compares the rendering of rays with the measurements along them; a ``Term`` adds a robust loss, a weight and
the rays that it applies to; an ``Objective`` is a sum of terms (eq. 5).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bidnerf_core.fields import Observations, Rendering
from bidnerf_core.geometry import Robust

Residual: TypeAlias = Callable[[Rendering, Observations], Float[Tensor, "*p c"]]
"""Compares renderings with measurements, ray by ray; differentiable in the rendering."""
DepthResidual: TypeAlias = Callable[[Rendering, Observations], Float[Tensor, "*p"]]
"""Compares rendered with measured distances. Must not be NaN where nothing was measured, since such rays are masked only afterwards."""


def depth_residual(rendering: Rendering, observed: Observations) -> Float[Tensor, "*p"]:
    """Return rendered minus measured distance (metres; eq. 5). A ray that hits nothing has a rendered distance of 0."""
    return rendering.distance - observed.distance


def truncated_depth_residual(rendering: Rendering, observed: Observations) -> Float[Tensor, "*p"]:
    """Return ``sum_i w_i clip(t_i - d) + (1 - sum_i w_i) 0.3`` (metres), where clip limits to +-0.3.

    At a silhouette, part of the weight lies on a surface far behind. Here the contribution of this weight is limited, however far
    away the surface is; in the paper's residual it counts with its full distance.
    """
    limit = 0.3
    offset = (rendering.samples.middles - observed.distance[..., None]).clamp(-limit, limit)
    return (rendering.weights * offset).sum(-1) + (1 - rendering.opacity) * limit


def first_surface_residual(rendering: Rendering, observed: Observations) -> Float[Tensor, "*p"]:
    """Return rendered minus measured distance of the first surface (metres); 0 for a ray that no surface stops.

    The first surface is where the cumulative weight reaches half of the ray's total; its distance is the weighted mean within
    0.1 m.
    """
    middles, weights = rendering.samples.middles, rendering.weights
    if middles.shape[-1] == 0:
        return torch.zeros_like(rendering.distance)
    with torch.no_grad():
        met = weights.cumsum(-1) >= rendering.opacity[..., None] / 2
        first = torch.where(met & rendering.samples.valid, middles, torch.inf).amin(-1, keepdim=True)
        near = (middles - first).abs() <= 0.1
    share = torch.where(near, weights, 0)
    distance = (share * middles).sum(-1) / share.sum(-1).clamp(min=1e-6)
    return torch.where(rendering.opacity > 0.5, distance - observed.distance, 0)


DEPTH_RESIDUALS: dict[str, DepthResidual] = {
    "distance": depth_residual,
    "truncated": truncated_depth_residual,
    "first-surface": first_surface_residual,
}
"""Depth residuals by the names that the setting ``depth_residual`` accepts. Users may add others."""


def free_space(rendering: Rendering, distance: Float[Tensor, "*p"], margin: float) -> Float[Tensor, "*p"]:
    """Return the weighted sum, over the samples of a ray, of how far (metres) they lie in front of ``distance - margin``.

    A sensor that measured a distance saw nothing in front of it. The error of the mean distance can be 0 even
    with matter on both sides of the measured point; this residual cannot.
    """
    before = (distance[..., None] - margin - rendering.samples.middles).clamp(min=0)
    return (rendering.weights * before).sum(-1)


def masked_mean(values: Float[Tensor, "*k p"], mask: Bool[Tensor, "*k p"]) -> Float[Tensor, "*k"]:
    """Return the mean of the values selected by ``mask`` along the last axis; 0 where none is selected."""
    return torch.where(mask, values, 0).sum(-1) / mask.sum(-1).clamp(min=1)


@dataclass(frozen=True)
class Term:
    """One kind of residual with its robust loss and its weight."""

    residual: Residual
    robust: Robust
    weight: float
    # whether it applies to rays with a measured distance, or else to those with a colour
    of_depth: bool = True

    def loss(self, rendering: Rendering, observed: Observations) -> Float[Tensor, "*k"]:
        """Return the weighted mean of rho over the rays (last axis) that the term applies to, summed over channels."""
        rho = self.robust(self.residual(rendering, observed)).sum(-1)
        return self.weight * masked_mean(rho, observed.measured if self.of_depth else observed.coloured)


@dataclass(frozen=True)
class Objective:
    """The objective that first-order methods minimize: a sum of terms."""

    terms: tuple[Term, ...]

    def loss(self, rendering: Rendering, observed: Observations) -> Float[Tensor, ""]:
        """Return ``1/K sum_i [mean_r rho(rgb) + lambda_d mean_r rho(d)]`` (eqs. 5 and 6) for rays of shape (K images, rays).

        Each term is a mean over the rays that it applies to: the depth term over those where depth was measured.
        """
        return torch.stack([term.loss(rendering, observed) for term in self.terms]).sum(0).mean()

    @property
    def uses_depth(self) -> bool:
        """Whether any term needs measured distances."""
        return any(term.of_depth for term in self.terms)


def colour_term(robust: Robust) -> Term:
    """Return the photometric term, with weight 1."""
    return Term(lambda rendering, observed: rendering.rgb - observed.rgb, robust, 1.0, of_depth=False)


def depth_term(robust: Robust, weight: float, residual: DepthResidual = depth_residual) -> Term:
    """Return the depth term with its weight lambda_d; ``robust`` is in the unit of ``residual``."""

    def masked(rendering: Rendering, observed: Observations) -> Float[Tensor, "*p 1"]:
        return torch.where(observed.measured, residual(rendering, observed), 0)[..., None]

    return Term(masked, robust, weight)


def free_space_term(robust: Robust, weight: float) -> Term:
    """Return the term for matter that lies in front of the measured distance by more than the scale of ``robust`` (metres)."""
    return Term(lambda seen, observed: free_space(seen, observed.distance, robust.scale)[..., None], robust, weight)


def opacity_term(weight: float) -> Term:
    """Return a term that penalizes transmittance along rays with a measured distance, as the scene must be opaque there."""
    return Term(lambda rendering, observed: (1 - rendering.opacity)[..., None], Robust("l2", 1.0), weight)
