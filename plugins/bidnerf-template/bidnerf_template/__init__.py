"""A minimal backend: a voxel grid with trilinear interpolation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Generator, Tensor, nn
from torch.nn import functional

from bidnerf_core.backend import (
    FieldValues,
    Report,
    SceneBounds,
    StepOutcome,
    Stratified,
    Supervision,
    SupervisionConfig,
    View,
    device_of,
)

__all__ = ["TemplateBackend", "TemplateConfig", "TemplateField", "backend"]


@dataclass(frozen=True)
class TemplateConfig(SupervisionConfig):
    """Each field is an option of ``bidnerf train`` and is stored with the map, so it must be JSON-serializable."""

    resolution: int = 96  # grid points along each axis of the modelled space
    samples: int = 96  # samples along a ray
    steps: int = 1500  # steps of the optimizer
    rays_per_step: int = 2048  # number of rays per step
    learning_rate: float = 0.1  # initial learning rate


class TemplateField(nn.Module):
    """The radiance field. Only its ``state_dict`` is saved."""

    def __init__(self, config: TemplateConfig, bounds: SceneBounds) -> None:
        super().__init__()
        self.bounds = bounds
        self.side = max(bounds.size)
        self.sampler = Stratified(config.samples, bounds)
        self.grid = nn.Parameter(torch.zeros(4, *[config.resolution] * 3))  # density and rgb, before activation

    def query(self, positions: Tensor, directions: Tensor) -> FieldValues:
        """Return density (* per metre) and rgb (* 3) at positions (* 3, metres, world) along unit directions (* 3)."""
        places = self.bounds.normalized(positions).reshape(1, -1, 1, 1, 3)  # in [-1, 1]
        raw = functional.grid_sample(self.grid[None], places, padding_mode="border", align_corners=True)
        raw = raw.reshape(4, *positions.shape[:-1])
        density = functional.softplus(raw[0] - 4) * 100 / self.side  # thin at first, regardless of the length unit
        return FieldValues(density, raw[1:].sigmoid().movedim(0, -1))


class TemplateBackend:
    """The object that the entry point names."""

    summary = "a grid of voxels with trilinear interpolation"
    config_type = TemplateConfig

    def build(self, config: TemplateConfig, bounds: SceneBounds) -> TemplateField:
        return TemplateField(config, bounds)

    def train(self, field: TemplateField, views: Sequence[View], config: TemplateConfig, report: Report) -> None:
        supervision = Supervision(views, field.bounds, config, device_of(field))

        def outcome(step: int, generator: Generator) -> StepOutcome:
            return supervision.step(field, config.rays_per_step, generator)

        groups = [{"params": list(field.parameters()), "lr": config.learning_rate}]
        supervision.fit(field, groups, outcome, config.steps, report)


backend = TemplateBackend()
