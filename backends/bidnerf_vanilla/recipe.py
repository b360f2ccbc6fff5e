"""Training of a NeRF: its settings and its recipe."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import torch
from torch import Generator

from bidnerf_core.carving import occupied_voxels
from bidnerf_core.errors import InputError
from bidnerf_core.fields import device_of
from bidnerf_core.frames import View
from bidnerf_core.settings import Count, Positive, Range
from bidnerf_core.training import (
    Replayable,
    Report,
    StepOutcome,
    Supervision,
    SupervisionConfig,
)
from bidnerf_vanilla.field import FieldConfig, VanillaField

PROBE = 4096
"""Number of rays from which the mean number of samples per ray is estimated."""


@dataclass(frozen=True)
class VanillaConfig(FieldConfig, SupervisionConfig):
    """Size and training of the field. With the defaults, training takes about forty minutes on a small CPU."""

    steps: Count = 20000  # steps of the optimizer
    # approximate number of samples of the fine network per step, which determines the number of rays
    samples_per_step: Count = 4096
    rays_at_most: Count = 4096  # maximum number of rays per step
    learning_rate: Positive = 3e-3  # initial learning rate
    seed: Annotated[int, Range(0), "N"] = 0  # seed of the initial weights and of all random draws
    carve: bool = True  # skip the cells that the views' depth and silhouettes show to be empty

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (self.include_input or self.position_frequencies):
            raise InputError("position_frequencies is 0 without include_input", expected="one of them")


def train(field: VanillaField, views: Sequence[View], config: VanillaConfig, report: Report) -> None:
    """Fit ``field`` to ``views``; see ``Supervision.fit`` for checkpoints and stopping."""
    if config.carve:
        field.room.cells.copy_(occupied_voxels(views, field.room.grid, device=device_of(field)))
    supervision = Supervision(views, field.bounds, config, device_of(field))
    rays_per_step = _rays_per_step(field, supervision, config)

    def outcome(step: int, generator: Generator) -> StepOutcome:
        return supervision.step(field, rays_per_step, generator)  # eq. 6

    groups = [{"params": list(field.parameters()), "lr": config.learning_rate}]
    steps = Replayable(lambda step: "all steps are alike", outcome)
    supervision.fit(field, groups, steps, config.steps, report, seed=config.seed)


@torch.no_grad()
def _rays_per_step(field: VanillaField, supervision: Supervision, config: VanillaConfig) -> int:
    """Return the number of rays per step: the fewer samples per ray, the more rays."""
    rays = supervision.draw(PROBE, Generator().manual_seed(config.seed)).rays
    coarse = field.coarse.sampler(rays).valid
    samples = float(coarse.sum() + config.fine_samples * coarse.any(-1).sum()) / PROBE
    return max(1, min(config.rays_at_most, int(config.samples_per_step / max(samples, 1.0))))
