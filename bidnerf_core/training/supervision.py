"""Supervision of a field by training views: batches of their rays, and the rendering loss."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Generator, Tensor, nn

from bidnerf_core.fields import RadianceField, Rendering, SceneBounds, levels, render
from bidnerf_core.frames import View
from bidnerf_core.settings import NotNegative, Settings
from bidnerf_core.training.loop import Replayable, Report, StepOutcome, cosine, fit
from bidnerf_core.training.loss import ColourTransforms, distortion, supervised_loss
from bidnerf_core.training.photos import relative_detail
from bidnerf_core.training.ray_bank import RayBank, TrainingBatch


@dataclass(frozen=True)
class SupervisionConfig(Settings):
    """Weights of the loss terms, for every recipe."""

    # weight of depth, from sensors or landmarks, relative to colour; 0 leaves it out
    depth_weight: NotNegative = 0.1
    # weight of the distortion loss, which concentrates a ray's weight at one depth
    distortion_weight: NotNegative = 0.0
    exposure: bool = True  # learn a colour transform of each image, unless images have alpha
    sharpness: bool = True  # down-weight blurred images


class Supervision:
    """The rays of training views and their loss, on the device of the trained field.

    This class learns the exposure and white balance of each image alongside the field, so that differences in
    exposure do not affect the field's colours, down-weights blurred images, and takes depth from sensors
    and landmarks. A simple recipe is ``fit`` with ``step`` as its outcome; others compose ``draw``,
    ``render`` and ``loss``.
    """

    def __init__(
        self, views: Sequence[View], bounds: SceneBounds, config: SupervisionConfig, device: torch.device | str = "cpu"
    ) -> None:
        self.config = config
        self.bank = RayBank(views, bounds, device)
        self.side = bounds.side
        learned = config.exposure and not self.bank.has_alpha
        self.colours = ColourTransforms(len(views)).to(device) if learned else None
        detail = relative_detail(views) if config.sharpness else None
        # None if no image is blurred, so that the loss is then unweighted.
        self.image_weight = None if detail is None or bool((detail == 1).all()) else detail.float().to(device)

    def fit(
        self,
        field: nn.Module,
        groups: list[dict[str, Any]],
        outcome: Callable[[int, Generator], StepOutcome],
        steps: int,
        report: Report,
        schedule: Callable[[int, int], float] = cosine,
        seed: int = 0,
    ) -> None:
        """Call ``training.fit``, also learning the per-image parameters, which are saved and restored with the field."""
        learned = [] if self.colours is None else [{"params": list(self.colours.parameters()), "lr": 2e-3}]
        if isinstance(outcome, Replayable) and self.bank.home != self.bank.device:
            outcome = outcome.__call__  # batches are copied, which cannot be replayed
        fit(field, [*groups, *learned], outcome, steps, report, schedule, seed, beside=self.colours)

    def step(self, field: RadianceField, count: int, generator: Generator) -> StepOutcome:
        """Render ``count`` rays drawn from the views with every level of the field, and return the sum of their losses.

        The colour error and the number of samples are those of the finest level.
        """
        batch = self.draw(count, generator)
        renderings = [render(level, batch.rays, batch.background, generator) for level in levels(field)]
        losses, errors = zip(*(self.loss(rendering, batch) for rendering in renderings), strict=True)
        samples = renderings[-1].samples.valid.sum() / len(batch)
        return StepOutcome(torch.stack(losses).sum(), errors[-1], samples)

    def draw(self, count: int, generator: Generator) -> TrainingBatch:
        """Return a batch of ``count`` rays; see ``RayBank.draw``."""
        return self.bank.draw(count, generator)

    def loss(self, rendering: Rendering, batch: TrainingBatch) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
        """Return the loss of a rendering of the batch's rays, and its mean squared colour error for display."""
        if self.colours is not None:
            rendering = replace(rendering, rgb=self.colours(rendering.rgb, batch.image))
        weight = None if self.image_weight is None else self.image_weight[batch.image]
        depth_weight = self.config.depth_weight if self.bank.has_distances else 0.0
        loss, mse = supervised_loss(rendering, batch, self.side, depth_weight, weight)
        if self.colours is not None:
            loss = loss + 1e-3 * self.colours.penalty()  # relative to the colour error
        if self.config.distortion_weight:
            loss = loss + self.config.distortion_weight * distortion(rendering, self.side)
        return loss, mse
