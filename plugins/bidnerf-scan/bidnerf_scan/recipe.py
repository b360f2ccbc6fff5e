"""Training: discs on measured depth or anywhere, whose colours and opacities are fitted to images."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import torch
from jaxtyping import Float
from torch import Generator, Tensor

from bidnerf_core.fields import SceneBounds, device_of
from bidnerf_core.frames import View, draw, uniform
from bidnerf_core.settings import Count, NotNegative, Range
from bidnerf_core.training import Report, StepOutcome, Supervision, SupervisionConfig, cosine
from bidnerf_scan.field import FieldConfig, ScanField
from bidnerf_scan.pieces import Pieces, cloud_pieces, thinned

OPACITY = 0.1
"""Initial opacity of a disc that is placed anywhere."""


@dataclass(frozen=True)
class ScanConfig(FieldConfig, SupervisionConfig):
    """Size and training of the field."""

    steps: Count = 1000  # steps of the optimizer
    rays_per_step: Count = 2048  # number of rays per step
    opacity_rate: NotNegative = 0.05  # learning rate of the logits of the opacities
    colour_rate: NotNegative = 0.02  # learning rate of the colours
    seed: Annotated[int, Range(0)] = 0  # seed of all random draws


def config_of(pieces: Pieces) -> ScanConfig:
    """Return a config whose size matches these pieces."""
    if pieces.textures is None:
        return ScanConfig(pieces=len(pieces))
    return ScanConfig(pieces=len(pieces), images=len(pieces.textures.shapes), texels=len(pieces.textures.texels))


def train(field: ScanField, views: Sequence[View], config: ScanConfig, report: Report) -> None:
    """Fit ``field`` to ``views``; see ``fit`` on checkpoints and stopping.

    Discs are placed where the views measured depth and do not move. Without measured depth, they are placed
    anywhere in the scene's box, and only their colours and opacities distinguish matter from free space.
    """
    supervision = Supervision(views, field.bounds, config, device_of(field))
    if report.resume() is None:
        field.assign(first_pieces(field, views, Generator().manual_seed(config.seed)))

    def outcome(step: int, generator: Generator) -> StepOutcome:
        return supervision.step(field, config.rays_per_step, generator)

    groups = [
        {"params": [field.logits], "lr": config.opacity_rate},
        {"params": [field.rgb], "lr": config.colour_rate},
    ]
    supervision.fit(field, groups, outcome, config.steps, report, cosine, config.seed)


def first_pieces(field: ScanField, views: Sequence[View], generator: Generator) -> Pieces:
    """Return as many discs as the field has: on measured depth if there is some, else anywhere."""
    count = len(field.corner)
    points, rgb = _measured(views, field.bounds, 8 * count, generator)  # eight pixels for each disc
    if len(points) < 100:  # too few, so that discs are placed anywhere
        lower, size = torch.tensor(field.bounds.lower), torch.tensor(field.bounds.size)
        return _anywhere(field, lower + size * torch.rand((count, 3), generator=generator), generator)
    points, colours = thinned(points, rgb, count)
    assert colours is not None
    found = cloud_pieces(points, colours)
    # The number of grid cells is never exactly the wanted one; copies are transparent.
    missing = count - len(found)
    again = torch.randint(len(found), (missing,), generator=generator)
    every = torch.cat([torch.arange(len(found)), again])
    logits = torch.cat([found.logits, torch.full((missing,), -20.0)])
    return Pieces(
        found.corner[every],
        found.first[every],
        found.second[every],
        found.rgb[every],
        logits,
        found.is_round[every],
    )


def _measured(
    views: Sequence[View], bounds: SceneBounds, most: int, generator: Generator
) -> tuple[Float[Tensor, "p 3"], Float[Tensor, "p 3"]]:
    """Return points within the box (metres, world) at which the views measured depth, and their colours."""
    measured = [view for view in views if view.frame.has_depth]
    if not measured:
        return torch.zeros(0, 3), torch.zeros(0, 3)
    pixels = draw(measured, max(most, len(measured)), uniform, generator).flattened()
    points = pixels.origins + pixels.distance[:, None] * pixels.directions
    inside = (points >= points.new_tensor(bounds.lower)) & (points <= points.new_tensor(bounds.upper))
    kept = (pixels.distance > 0) & inside.all(-1)
    return points[kept].float(), pixels.rgb[kept].float()


def _anywhere(field: ScanField, points: Float[Tensor, "n 3"], generator: Generator) -> Pieces:
    count = len(points)
    radius = field.bounds.side / max(2.0, count ** (1 / 3))
    edges = torch.linalg.qr(torch.randn((count, 3, 2), generator=generator)).Q * radius
    rgb = torch.zeros(count, 3, 3)
    rgb[:, 0] = 0.5
    logit = math.log(OPACITY / (1 - OPACITY))
    return Pieces(
        points,
        edges[..., 0],
        edges[..., 1],
        rgb,
        torch.full((count,), logit),
        torch.ones(count, dtype=torch.bool),
    )
