"""Training of Gaussians on rays, starting where depth, landmarks or silhouettes show matter."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any

import torch
from torch import Generator, Tensor

from bidnerf_core.fields import device_of
from bidnerf_core.frames import View
from bidnerf_core.settings import Count, NotNegative, Positive, Range
from bidnerf_core.training import Report, StepOutcome, Supervision, SupervisionConfig, cosine
from bidnerf_gaussians.field import FieldConfig, GaussiansField
from bidnerf_gaussians.placing import first_gaussians
from bidnerf_gaussians.relocation import relocate

NARROWEST = 0.25
"""Smallest standard deviation of a Gaussian, in pixel footprints: smaller ones would fall between the rays."""
FLATTEST = 0.01
"""Like ``NARROWEST``, if the footprint is unknown: in units of the mean distance between the Gaussians of a surface."""


@dataclass(frozen=True)
class GaussiansConfig(FieldConfig, SupervisionConfig):
    """Size and training of the field."""

    steps: Count = 6000  # steps of the optimizer
    rays_per_step: Count = 2048  # number of rays per step
    # learning rate of the means, in units of the mean distance between the Gaussians of a surface
    mean_rate: NotNegative = 0.02
    scale_rate: NotNegative = 0.01  # learning rate of the logarithms of the scales
    turn_rate: NotNegative = 0.005  # learning rate of the quaternions
    opacity_rate: NotNegative = 0.05  # learning rate of the logits of the opacities
    colour_rate: NotNegative = 0.02  # learning rate of the colours; a tenth of it for the other harmonics
    seed: Annotated[int, Range(0)] = 0  # seed of all random draws
    refit_every: Count = 10  # steps between updates of the tree of boxes
    relocate_every: Count = 100  # steps between relocations of Gaussians that are hardly visible
    relocate_until: Annotated[float, Range(0, 1)] = 0.7  # fraction of the steps with relocations
    # weight of the mean opacity, which makes unneeded Gaussians vanish
    opacity_weight: NotNegative = 0.001
    least_opacity: Positive = 0.01  # opacity below which a Gaussian is relocated


def train(field: GaussiansField, views: Sequence[View], config: GaussiansConfig, report: Report) -> None:
    """Fit ``field`` to ``views``; see ``fit`` on checkpoints and stopping."""
    supervision = Supervision(views, field.bounds, config, device_of(field))
    unit = _unit(field)
    if report.resume() is None:
        field.assign(first_gaussians(field, views, unit, Generator().manual_seed(config.seed)))
    least = math.log(NARROWEST * field.bounds.footprint or FLATTEST * unit)

    def outcome(step: int, generator: Generator) -> StepOutcome:
        with torch.no_grad():
            field.log_scales.clamp_(min=least)
        moving = step <= config.relocate_until * config.steps
        if step and step % config.relocate_every == 0 and moving:
            relocate(field, config.least_opacity, generator)
            field.refit()
        elif step % config.refit_every == 0 or step == config.steps - 1:
            field.refit()
        rendered = supervision.step(field, config.rays_per_step, generator)
        return replace(rendered, loss=rendered.loss + config.opacity_weight * field.logits.sigmoid().mean())

    supervision.fit(field, _groups(field, config, unit), outcome, config.steps, report, cosine, config.seed)


def _unit(field: GaussiansField) -> float:
    """Return the mean distance (metres) between the Gaussians, if they cover a surface as large as one side of the scene's cube."""
    return field.bounds.side / math.sqrt(max(2, len(field.means)))


def _groups(field: GaussiansField, config: GaussiansConfig, unit: float) -> list[dict[str, Any]]:
    rates: list[tuple[Tensor, float]] = [
        (field.means, config.mean_rate * unit),
        (field.log_scales, config.scale_rate),
        (field.quaternions, config.turn_rate),
        (field.logits, config.opacity_rate),
        (field.harmonics, config.colour_rate),
    ]
    return [{"params": [parameter], "lr": rate} for parameter, rate in rates]
