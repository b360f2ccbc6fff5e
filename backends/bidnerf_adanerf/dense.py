"""Dense training, in which all bins of a ray are shaded and weighted by the oracle's scores."""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Generator, Tensor

from bidnerf_adanerf.field import AdaNerfField
from bidnerf_core.fields import FieldValues, OccupancyMask, Rays, RaySamples, Rendering


def dense_samples(
    field: AdaNerfField, rays: Rays, room: OccupancyMask | None, generator: Generator
) -> tuple[RaySamples, Tensor]:
    """Return the jittered bins, marked valid if they are shaded, and a mask (r n) of shaded bins that are known to be empty."""
    samples = field.bins(rays, generator)
    if room is None:
        return samples, torch.zeros_like(samples.valid)
    occupied = room.holds(rays.at(samples.middles))
    # A sixteenth of the bins known to be empty is shaded anyway, so that the field learns that they are empty.
    probed = (
        samples.valid
        & ~occupied
        & (torch.rand(occupied.shape, generator=generator, device=generator.device) < 1 / 16).to(occupied.device)
    )
    return replace(samples, valid=samples.valid & occupied | probed), probed


def soft_weights(scores: Float[Tensor, "r n"], threshold: float) -> Float[Tensor, "r n"]:
    """Return the weights of bins in the soft phase: 1 above the threshold, as in later phases, and proportional to the score below it.

    In the paper the weight is the score itself. Intermediate scores then drive the density too high, and the
    density stays too high once those bins count fully: on Lego the dense rendering lost 1 dB in this phase.
    """
    return (scores / max(threshold, 1e-6)).clamp(max=1)


def render_softly(
    values: FieldValues,
    samples: RaySamples,
    scores: Float[Tensor, "r n"],
    background: Float[Tensor, "r 3"],
) -> Rendering:
    """Render with each bin's opacity multiplied by its score (Kurz et al. 2022, section 3)."""
    absorbed = torch.where(samples.valid, values.density * (samples.ends - samples.starts), 0)
    alpha = -torch.expm1(-absorbed) * scores
    passed = torch.log1p(-alpha * (1 - 1e-6))  # logarithm of the transmittance; the factor keeps it finite
    weights = alpha * torch.exp(torch.cumsum(passed, dim=-1) - passed)
    opacity = weights.sum(-1)
    rgb = (weights[..., None] * values.rgb).sum(-2) + (1 - opacity)[..., None] * background
    return Rendering(rgb, (weights * samples.middles).sum(-1), opacity, weights, samples)


def opacity(values: FieldValues, samples: RaySamples, which: Bool[Tensor, "r n"]) -> Float[Tensor, ""]:
    """Return the mean opacity, ``1 - exp(-sigma dt)``, of the bins in the mask ``which``, without scores."""
    absorbed = torch.where(which, values.density * (samples.ends - samples.starts), 0)
    return -torch.expm1(-absorbed).sum() / which.sum().clamp(min=1)
