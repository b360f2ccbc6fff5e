"""Training of an AdaNeRF: first with all bins, then with fewer and fewer, and finally with only the bins that the oracle keeps."""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum
from functools import cache

import torch
from jaxtyping import Float
from torch import Generator, Tensor

from bidnerf_adanerf.bins import ray_logits
from bidnerf_adanerf.config import AdaNerfConfig
from bidnerf_adanerf.dense import dense_samples, opacity, render_softly, soft_weights
from bidnerf_adanerf.field import AdaNerfField
from bidnerf_adanerf.oracle_loss import oracle_loss
from bidnerf_core.carving import occupied_voxels
from bidnerf_core.devices import move_to
from bidnerf_core.fields import (
    OccupancyMask,
    SceneBounds,
    VoxelGrid,
    device_of,
    query_samples,
    rendering_weights,
)
from bidnerf_core.frames import View
from bidnerf_core.training import Replayable, Report, StepOutcome, Supervision, TrainingBatch

PROBE = 4096
"""Number of rays from which the mean number of samples per ray is estimated."""


class Phase(Enum):
    """The phases of training; each continues from the one before."""

    DENSE = "all bins are shaded and count; the oracle learns which of them matter"
    SOFT = "all bins are shaded and weighted by their scores, which are made sparse"
    SPARSE = "only the bins that the oracle chooses are shaded; the oracle is no longer trained"


def phase_at(step: int, config: AdaNerfConfig) -> Phase:
    """Return the phase of training to which a step belongs."""
    soft = round(config.dense_part * config.steps)
    sparse = round((config.dense_part + config.soft_part) * config.steps)
    return Phase.DENSE if step < soft else Phase.SOFT if step < sparse else Phase.SPARSE


def sparsity(step: int, config: AdaNerfConfig) -> float:
    """Return the weight of the mean score in the loss: 0 before the soft phase, then increasing linearly until that is half over."""
    begin, length = config.dense_part * config.steps, config.soft_part * config.steps
    return config.sparsity_weight * min(1.0, max(0.0, (step - begin) / max(1.0, length / 2)))


def train(field: AdaNerfField, views: Sequence[View], config: AdaNerfConfig, report: Report) -> None:
    """Fit ``field`` to ``views``; see ``Supervision.fit`` for checkpoints and stopping."""
    room = room_for_matter(views, field.bounds, config.room_resolution) if config.carve else None
    room = move_to(room, device_of(field))
    supervision = Supervision(views, field.bounds, config, device_of(field))

    @cache
    def rays_per_step(sparse: bool) -> int:  # constant in a phase, even if training is resumed
        probe = supervision.draw(PROBE, Generator().manual_seed(config.seed)).rays
        generator = Generator().manual_seed(config.seed)
        samples = field.sampler(probe) if sparse else dense_samples(field, probe, room, generator)[0]
        evaluations = 1 + float(samples.valid.sum()) / PROBE  # the oracle costs about as much as a sample
        return max(1, min(config.rays_at_most, int(config.samples_per_step / evaluations)))

    weight = torch.zeros((), device=device_of(field))  # of the mean score, see ``sparsity``

    def prepare(step: int) -> Phase:
        weight.fill_(sparsity(step, config))
        rays_per_step(phase_at(step, config) is Phase.SPARSE)
        return phase_at(step, config)

    def outcome(step: int, generator: Generator) -> StepOutcome:
        phase = phase_at(step, config)
        if phase is Phase.SPARSE:  # as in localization; the oracle is no longer trained
            return supervision.step(field, rays_per_step(True), generator)
        batch = supervision.draw(rays_per_step(False), generator)
        return dense_step(field, supervision, batch, room, phase, weight, generator)

    groups = [{"params": list(field.parameters()), "lr": config.learning_rate}]
    supervision.fit(field, groups, Replayable(prepare, outcome), config.steps, report, seed=config.seed)


def room_for_matter(views: Sequence[View], bounds: SceneBounds, resolution: int) -> OccupancyMask:
    """Return the cells that may hold matter according to the training views; used only in training and not saved."""
    room = OccupancyMask(VoxelGrid.cube(bounds, resolution))
    room.cells.copy_(occupied_voxels(views, room.grid))
    return room


def dense_step(
    field: AdaNerfField,
    supervision: Supervision,
    batch: TrainingBatch,
    room: OccupancyMask | None,
    phase: Phase,
    sparsity_weight: Float[Tensor, ""],
    generator: Generator,
) -> StepOutcome:
    """Return the outcome of a step that shades all bins, each weighted fully or, in the soft phase, according to its score."""
    config = supervision.config
    assert isinstance(config, AdaNerfConfig)
    samples, empty = dense_samples(field, batch.rays, room, generator)
    values = query_samples(field, batch.rays, samples)
    logits = ray_logits(field.oracle, field.bins, batch.rays)
    scores = logits.sigmoid()
    counted = torch.ones_like(scores)
    if phase is Phase.SOFT:
        counted = soft_weights(scores, config.threshold)
    rendering = render_softly(values, samples, counted, batch.background)
    loss, mse = supervision.loss(rendering, batch)
    loss = loss + config.empty_weight * opacity(values, samples, empty)
    whole = rendering_weights(values.density, samples)
    loss = loss + config.oracle_weight * oracle_loss(logits, samples, whole, batch)
    loss = loss + sparsity_weight * scores.mean()
    shaded = (samples.valid & (scores > config.threshold)).sum() / len(scores)
    return StepOutcome(loss, mse, shaded)
