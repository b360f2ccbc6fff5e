"""How an AdaNeRF is trained: densely, then with ever fewer bins, then at the bins that are left."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import torch
from jaxtyping import Float
from torch import Generator, Tensor
from torch.nn import functional

from bidnerf_adanerf.bins import ray_logits
from bidnerf_adanerf.config import AdaNerfConfig
from bidnerf_adanerf.dense import Room, dense_samples, render_softly
from bidnerf_adanerf.field import AdaNerfField
from bidnerf_core.field import RaySamples
from bidnerf_core.frames import View
from bidnerf_core.rendering import query_samples, render
from bidnerf_core.supervision import supervised_loss
from bidnerf_core.training import RayBank, RayBatch, Report, StepOutcome, fit

PROBE = 4096
"""Rays from which is learnt how many samples a ray takes."""
BLUR = 2.0
"""How many bins from the measured depth a bin may be and still count for something."""


def train(field: AdaNerfField, views: Sequence[View], config: AdaNerfConfig, report: Report) -> None:
    """Fit ``field`` to ``views``; see ``fit`` for checkpoints and stopping."""
    room = Room.left_by(views, field.bounds, config.room_resolution) if config.carve else None
    bank = RayBank(views, field.bounds)

    @cache
    def rays_per_step(sparse: bool) -> int:  # nothing changes it during a phase, nor where training resumes
        probe = bank.draw(PROBE, Generator().manual_seed(config.seed)).rays
        generator = Generator().manual_seed(config.seed)
        samples = field.sampler(probe) if sparse else dense_samples(field, probe, room, generator)[0]
        asked = 1 + float(samples.valid.sum()) / PROBE  # the oracle costs about as much as a sample
        return max(1, min(config.rays_at_most, int(config.samples_per_step / asked)))

    def outcome(step: int, generator: Generator) -> StepOutcome:
        sparse = step >= (config.dense_part + config.sparse_part) * config.steps
        batch = bank.draw(rays_per_step(sparse), generator)
        if sparse:
            return sparse_step(field, batch, config, generator)
        return dense_step(field, batch, room, config, sparsity(step, config), generator)

    groups = [{"params": list(field.parameters()), "lr": config.learning_rate}]
    fit(field, groups, outcome, config.steps, report, seed=config.seed)


def sparsity(step: int, config: AdaNerfConfig) -> float:
    """Weight of the scores' mean: none in the dense phase, then growing to its full value."""
    begin, length = config.dense_part * config.steps, config.sparse_part * config.steps
    return config.sparsity_weight * min(1.0, max(0.0, (step - begin) / max(1.0, length / 2)))


def dense_step(
    field: AdaNerfField, batch: RayBatch, room: Room | None, config: AdaNerfConfig, weight: float, generator: Generator
) -> StepOutcome:  # fmt: skip
    """All bins, each counting as much as its score says; ``weight`` is what a score of 1 costs."""
    samples, empty = dense_samples(field, batch.rays, room, generator)
    values = query_samples(field, batch.rays, samples)
    logits = ray_logits(field.oracle, field.bins, batch.rays)
    scores = logits.sigmoid()
    rendering = render_softly(values, samples, scores, batch.background)
    loss, mse = supervised_loss(rendering, batch, field.side, config.depth_weight)
    wasted = (values.density * (samples.ends - samples.starts))[empty]
    loss = loss + 0.1 * -torch.expm1(-wasted).sum() / empty.sum().clamp(min=1)
    loss = loss + weight * scores.mean() + config.oracle_weight * depth_lesson(logits, samples, batch)
    shaded = (samples.valid & (scores > config.threshold)).sum() / len(scores)
    return StepOutcome(loss, mse, float(shaded))


def depth_lesson(logits: Float[Tensor, "r n"], samples: RaySamples, batch: RayBatch) -> Float[Tensor, ""]:
    """Cross entropy of the scores with soft targets about the measured depth (Neff et al. 2021, DONeRF, section 4)."""
    measured = batch.distance > 0
    width = (samples.ends - samples.starts).clamp(min=1e-6)
    away = (samples.middles - batch.distance[:, None]).abs() / width  # in bins
    target = (1 - away / BLUR).clamp(min=0)
    error = functional.binary_cross_entropy_with_logits(logits, target, reduction="none").mean(-1)
    return torch.where(measured, error, 0).sum() / measured.sum().clamp(min=1)


def sparse_step(
    field: AdaNerfField, batch: RayBatch, config: AdaNerfConfig, generator: Generator
) -> StepOutcome:
    """As in localization: the oracle, which learns no more, chooses, and the shading network makes the best of it."""
    rendering = render(field, batch.rays, batch.background, generator)
    loss, mse = supervised_loss(rendering, batch, field.side, config.depth_weight)
    return StepOutcome(loss, mse, float(rendering.samples.valid.sum() / len(batch.rgb)))
