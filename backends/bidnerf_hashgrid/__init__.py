"""Multiresolution hash grid with an occupancy grid (Instant-NGP, Mueller et al. 2022), in pure torch."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from bidnerf_core.field import SceneBounds
from bidnerf_core.frames import View
from bidnerf_core.training import Report
from bidnerf_hashgrid.field import HashGridField
from bidnerf_hashgrid.recipe import HashGridConfig, train

__all__ = ["HashGridBackend", "HashGridConfig", "HashGridField", "backend"]


class HashGridBackend:
    """What the entry point names."""

    summary = "multiresolution hash grid with an occupancy grid (Instant-NGP), pure torch"
    config_type = HashGridConfig

    def quick_config(self) -> HashGridConfig:
        """For small, simple scenes: about a minute on two cores."""
        return HashGridConfig(
            steps=400, samples_per_step=16384, learning_rate=2e-2, colour_layers=1, coarse_every=8
        )

    def build(self, config: HashGridConfig, bounds: SceneBounds) -> HashGridField:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(config.seed)
            return HashGridField(config, bounds)

    def train(
        self, field: HashGridField, views: Sequence[View], config: HashGridConfig, report: Report
    ) -> None:
        train(field, views, config, report)


backend = HashGridBackend()
