"""The oracle's own loss, whose targets come from measured depth and from the shaded bins themselves."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from bidnerf_core.fields import RaySamples
from bidnerf_core.training import TrainingBatch

BLUR = 2.0
"""Distance from the measured depth, in bins, at which a bin's target has fallen to 0."""
ENOUGH = 0.1
"""Rendering weight at which a bin's target reaches 1."""


def oracle_loss(
    logits: Float[Tensor, "r n"],
    samples: RaySamples,
    weights: Float[Tensor, "r n"],
    batch: TrainingBatch,
) -> Float[Tensor, ""]:
    """Return the cross entropy of the scores with soft targets in [0, 1], averaged over the rays that meet the scene.

    ``samples`` are all bins, and ``weights`` are the bins' volume rendering weights without scores. A network that classifies bins
    learns faster than one that is trained through the rendered colour alone (Neff et al. 2021, DONeRF, section 4).
    """
    target = torch.maximum(by_weight(weights.detach()), by_depth(samples, batch))
    error = functional.binary_cross_entropy_with_logits(logits, target, reduction="none").mean(-1)
    met = batch.rays.far > batch.rays.near
    return torch.where(met, error, 0).sum() / met.sum().clamp(min=1)


def by_weight(weights: Float[Tensor, "r n"]) -> Float[Tensor, "r n"]:
    """Return targets in [0, 1] that rise with a bin's weight and its neighbours' weights, since a surface may lie between bins."""
    beside = functional.max_pool1d(weights[:, None], 3, stride=1, padding=1)[:, 0]
    return ((weights + beside) / 2 / ENOUGH).clamp(max=1)


def by_depth(samples: RaySamples, batch: TrainingBatch) -> Float[Tensor, "r n"]:
    """Return targets that are 1 at the measured depth and fall off with distance from it; 0 on rays without a measurement."""
    width = (samples.ends - samples.starts).clamp(min=1e-9)
    away = (samples.middles - batch.observed.distance[:, None]).abs() / width  # in bins
    near = (1 - away / BLUR).clamp(min=0)
    return torch.where(batch.observed.measured[:, None], near, 0)
