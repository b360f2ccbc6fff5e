"""AdaNeRF (Kurz et al. 2022): a sampling network picks the few points of a ray that a shading network is asked at."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from bidnerf_adanerf.config import AdaNerfConfig
from bidnerf_adanerf.field import AdaNerfField
from bidnerf_adanerf.recipe import train
from bidnerf_core.field import SceneBounds
from bidnerf_core.frames import View
from bidnerf_core.training import Report

__all__ = ["AdaNerfBackend", "AdaNerfConfig", "AdaNerfField", "backend"]


class AdaNerfBackend:
    """What the entry point names."""

    summary = "AdaNeRF (Kurz et al. 2022): a sampling network picks the few points that a NeRF is asked at"
    config_type = AdaNerfConfig

    def build(self, config: AdaNerfConfig, bounds: SceneBounds) -> AdaNerfField:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(config.seed)
            return AdaNerfField(config, bounds)

    def train(
        self, field: AdaNerfField, views: Sequence[View], config: AdaNerfConfig, report: Report
    ) -> None:
        train(field, views, config, report)


backend = AdaNerfBackend()
