"""NeRF (Mildenhall et al. 2020): a coarse and a fine MLP with hierarchical sampling."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from bidnerf_core.field import SceneBounds
from bidnerf_core.frames import View
from bidnerf_core.training import Report
from bidnerf_vanilla.field import VanillaField
from bidnerf_vanilla.recipe import VanillaConfig, train

__all__ = ["VanillaBackend", "VanillaConfig", "VanillaField", "backend"]


class VanillaBackend:
    """What the entry point names."""

    summary = "NeRF (Mildenhall et al. 2020): a coarse and a fine MLP with hierarchical sampling"
    config_type = VanillaConfig

    def build(self, config: VanillaConfig, bounds: SceneBounds) -> VanillaField:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(config.seed)
            return VanillaField(config, bounds)

    def train(
        self, field: VanillaField, views: Sequence[View], config: VanillaConfig, report: Report
    ) -> None:
        train(field, views, config, report)


backend = VanillaBackend()
