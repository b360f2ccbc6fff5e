"""The supervision of a field by training views: batches of their rays, and the loss of rendering them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Generator, Tensor

from bidnerf_core.captures.photos import detail_kept
from bidnerf_core.fields.contract import SceneBounds
from bidnerf_core.fields.rendering import Rendering
from bidnerf_core.frames.frame import View
from bidnerf_core.settings import NotNegative, Settings
from bidnerf_core.training.colour_transform import ColourTransforms
from bidnerf_core.training.loss import distortion, supervised_loss
from bidnerf_core.training.ray_bank import RayBank, TrainingBatch

COLOUR_RATE = 2e-3  # learning rate of the colour transforms
COLOUR_PENALTY = 1e-3  # weight of their penalty relative to the colour error


@dataclass(frozen=True)
class SupervisionConfig(Settings):
    """Weights of the terms of the loss, for every recipe."""

    # weight of depth, from sensors or landmarks, relative to colour; 0 leaves it out
    depth_weight: NotNegative = 0.1
    distortion_weight: NotNegative = 0.0  # weight of the term that concentrates a ray's weight in one place
    exposure: bool = True  # learn a colour transform of each image, unless images have alpha
    sharpness: bool = True  # down-weight blurred images


class Supervision:
    """The rays of training views and their loss, on the device of the trained field."""

    def __init__(
        self, views: Sequence[View], bounds: SceneBounds, config: SupervisionConfig, device: torch.device | str = "cpu"
    ) -> None:  # fmt: skip
        self.config = config
        self.bank = RayBank(views, bounds, device)
        self.side = bounds.side
        learned = config.exposure and not self.bank.has_alpha
        self.colours = ColourTransforms(len(views)).to(device) if learned else None
        kept = detail_kept(views) if config.sharpness else None
        # None where no image is blurred, so that the loss is then unweighted.
        self.image_weight = None if kept is None or bool((kept == 1).all()) else kept.float().to(device)

    def draw(self, count: int, generator: Generator) -> TrainingBatch:
        return self.bank.draw(count, generator)

    def groups(self) -> list[dict[str, Any]]:
        """Return the parameters that are learned jointly with the field, as a group for ``fit``."""
        if self.colours is None:
            return []
        return [{"params": list(self.colours.parameters()), "lr": COLOUR_RATE}]

    def loss(self, rendering: Rendering, batch: TrainingBatch) -> tuple[Float[Tensor, ""], float]:
        """Return the loss of a rendering of the batch's rays, and its colour term alone for display."""
        if self.colours is not None:
            rendering = replace(rendering, rgb=self.colours(rendering.rgb, batch.image))
        weight = None if self.image_weight is None else self.image_weight[batch.image]
        loss, mse = supervised_loss(rendering, batch, self.side, self.config.depth_weight, weight)
        if self.colours is not None:
            loss = loss + COLOUR_PENALTY * self.colours.penalty()
        if self.config.distortion_weight:
            loss = loss + self.config.distortion_weight * distortion(rendering, self.side)
        return loss, mse
