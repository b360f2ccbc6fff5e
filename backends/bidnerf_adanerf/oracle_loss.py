"""What the oracle is taught directly: which bins matter, as measured depth and the shaded bins themselves tell."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from bidnerf_core.field import RaySamples
from bidnerf_core.training import TrainingBatch

BLUR = 2.0
"""How many bins from the measured depth a bin may be and still matter somewhat."""
ENOUGH = 0.1
"""Rendering weight from which on a bin matters fully."""


def oracle_loss(
    logits: Float[Tensor, "r n"],
    samples: RaySamples,
    weights: Float[Tensor, "r n"],
    batch: TrainingBatch,
) -> Float[Tensor, ""]:
    """Cross entropy of the scores with soft targets in [0, 1], over the rays that meet the scene.

    ``samples`` are all bins, ``weights`` what each has in volume rendering without scores. A network that classifies bins
    learns faster than one that feels its choice through the colour alone (Neff et al. 2021, DONeRF, section 4).
    """
    target = torch.maximum(by_weight(weights.detach()), by_depth(samples, batch))
    error = functional.binary_cross_entropy_with_logits(logits, target, reduction="none").mean(-1)
    met = batch.rays.far > batch.rays.near
    return torch.where(met, error, 0).sum() / met.sum().clamp(min=1)


def by_weight(weights: Float[Tensor, "r n"]) -> Float[Tensor, "r n"]:
    """A bin matters as far as it has weight, and half as far as its neighbours have: surfaces lie between bins, too."""
    beside = functional.max_pool1d(weights[:, None], 3, stride=1, padding=1)[:, 0]
    return ((weights + beside) / 2 / ENOUGH).clamp(max=1)


def by_depth(samples: RaySamples, batch: TrainingBatch) -> Float[Tensor, "r n"]:
    """A bin matters where depth was measured, and less the farther it is from there; not at all where none was."""
    width = (samples.ends - samples.starts).clamp(min=1e-9)
    away = (samples.middles - batch.observed.distance[:, None]).abs() / width  # in bins
    near = (1 - away / BLUR).clamp(min=0)
    return torch.where(batch.observed.measured[:, None], near, 0)
