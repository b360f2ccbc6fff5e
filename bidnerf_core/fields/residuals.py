"""Residuals between renderings and measurements, which every rendering method minimizes.

A ``Residual`` compares what is rendered along rays with what was measured there; a ``Term`` adds a robust
loss, a weight and the rays that it applies to; an ``Objective`` is a sum of terms (eq. 5). Adam uses the
objective's ``loss``, Levenberg-Marquardt its ``residuals``, ``weights`` and robust weights, so a change to a
residual changes every method.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bidnerf_core.fields.rendering import Observations, Rendering
from bidnerf_core.geometry import Robust


@runtime_checkable
class Residual(Protocol):
    """Compares renderings with measurements, ray by ray; differentiable in the rendering."""

    def __call__(self, rendering: Rendering, observed: Observations) -> Float[Tensor, "*p c"]: ...


@runtime_checkable
class DepthResidual(Protocol):
    """Compares rendered with measured distances.

    ``miss`` is the residual of a ray that hits nothing; None selects the paper's residual, in which such a
    ray has a rendered distance of 0.
    """

    def __call__(
        self, rendering: Rendering, observed: Observations, miss: float | None = None
    ) -> Float[Tensor, "*p"]: ...


def colour_residual(rendering: Rendering, observed: Observations) -> Float[Tensor, "*p 3"]:
    """Return rendered minus measured colour."""
    return rendering.rgb - observed.rgb


def depth_residual(
    rendering: Rendering, observed: Observations, miss: float | None = None
) -> Float[Tensor, "*p"]:
    """Return rendered minus measured distance, metres (eq. 5).

    With ``miss`` (metres) it is ``sum_i w_i (t_i - d) + (1 - sum_i w_i) miss``: the fraction of a ray that
    passes through the scene counts as if it hit something ``miss`` too far away. The paper's ``sum_i w_i t_i
    - d`` jumps by the whole distance at every silhouette, where its derivative is of no use to second-order
    steps.
    """
    if miss is None:
        return rendering.distance - observed.distance
    return rendering.distance - rendering.opacity * observed.distance + (1 - rendering.opacity) * miss


def truncated_depth_residual(
    rendering: Rendering, observed: Observations, miss: float | None = None
) -> Float[Tensor, "*p"]:
    """Return ``sum_i w_i clip(t_i - d) + (1 - sum_i w_i) miss``, metres, where clip limits to +-``miss`` (0.3 by default).

    At a silhouette, part of the weight lies on a surface far behind. Here its contribution is limited to
    ``miss``, however far away the surface is; in the paper's residual it counts with its full distance.
    """
    limit = 0.3 if miss is None else miss
    off = (rendering.samples.middles - observed.distance[..., None]).clamp(-limit, limit)
    return (rendering.weights * off).sum(-1) + (1 - rendering.opacity) * limit


def first_surface_residual(
    rendering: Rendering, observed: Observations, miss: float | None = None
) -> Float[Tensor, "*p"]:
    """Return how far the first surface lies behind the measured distance, metres; 0 for a ray that is not stopped.

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
"""Depth residuals by the names that the setting ``depth_residual`` accepts; add your own."""


def free_space(rendering: Rendering, distance: Float[Tensor, "*p"], margin: float) -> Float[Tensor, "*p"]:
    """Return how far (metres) matter on a ray lies in front of ``distance - margin``, summed with the
    rendering weights.

    A sensor that measured a distance saw nothing in front of it. The error of the mean distance can be 0 with
    matter on both sides of the measured point; this residual cannot.
    """
    before = (distance[..., None] - margin - rendering.samples.middles).clamp(min=0)
    return (rendering.weights * before).sum(-1)


def masked_mean(values: Float[Tensor, "*k p"], mask: Bool[Tensor, "*k p"]) -> Float[Tensor, "*k"]:
    """Return the mean over the last axis where ``mask`` holds; 0 where it holds nowhere."""
    kept = torch.where(mask, values, 0)
    return kept.sum(-1) / mask.sum(-1).clamp(min=1)


@dataclass(frozen=True)
class Term:
    """One kind of residual with its robust loss and its weight."""

    residual: Residual
    robust: Robust
    weight: float
    applies: Callable[[Observations], Bool[Tensor, "*p"]]  # which rays it is defined for

    def loss(self, rendering: Rendering, observed: Observations) -> Float[Tensor, "*k"]:
        """Return the weighted mean of rho over the rays (last axis) that the term applies to, summed over channels."""
        rho = self.robust(self.residual(rendering, observed)).sum(-1)
        return self.weight * masked_mean(rho, self.applies(observed))


@dataclass(frozen=True)
class Objective:
    """A sum of terms."""

    terms: tuple[Term, ...]

    def loss(self, rendering: Rendering, observed: Observations) -> Float[Tensor, ""]:
        """Return ``1/K sum_i [mean_r rho(rgb) + lambda_d mean_r rho(d)]`` (eqs. 5 and 6) of rays of shape (K images, rays).

        Each term is a mean over the rays that it applies to: the depth term over those where depth was measured.
        """
        return torch.stack([term.loss(rendering, observed) for term in self.terms]).sum(0).mean()

    @property
    def uses_depth(self) -> bool:
        """Whether any term needs measured distances."""
        return any(term.applies is measured for term in self.terms)


def coloured(observed: Observations) -> Bool[Tensor, "*p"]:
    """Return the mask of the rays along which a colour was measured."""
    return observed.coloured


def measured(observed: Observations) -> Bool[Tensor, "*p"]:
    """Return the mask of the rays along which a distance was measured."""
    return observed.measured


def colour_term(robust: Robust) -> Term:
    """Return the photometric term, with weight 1."""
    return Term(colour_residual, robust, 1.0, coloured)


def depth_term(
    robust: Robust, weight: float, residual: DepthResidual = depth_residual, miss: float | None = None
) -> Term:
    """Return the depth term with its weight lambda_d; ``robust`` is in the unit of ``residual``."""
    return Term(
        lambda rendering, observed: torch.where(observed.measured, residual(rendering, observed, miss), 0)[..., None],
        robust, weight, measured,
    )  # fmt: skip


def free_space_term(robust: Robust, weight: float) -> Term:
    """Return the term for matter that lies in front of the measured distance by more than the scale of
    ``robust`` (metres).
    """
    return Term(
        lambda rendering, observed: free_space(rendering, observed.distance, robust.scale)[..., None],
        robust,
        weight,
        measured,
    )


def opacity_term(weight: float) -> Term:
    """Return a term that penalizes transmittance along rays with a measured distance, as the scene must be opaque there."""
    return Term(
        lambda rendering, observed: (1 - rendering.opacity)[..., None], Robust("l2", 1.0), weight, measured
    )
