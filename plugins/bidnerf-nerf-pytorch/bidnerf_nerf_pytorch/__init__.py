"""Coarse and fine networks as krrish94/nerf-pytorch trains them; reads its checkpoints."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from bidnerf_core.field import SceneBounds
from bidnerf_core.frames import View
from bidnerf_core.training import Report
from bidnerf_nerf_pytorch.checkpoint import Checkpoint, read_checkpoint
from bidnerf_nerf_pytorch.field import NerfPytorchField
from bidnerf_nerf_pytorch.recipe import NerfPytorchConfig, train

__all__ = [
    "Checkpoint",
    "NerfPytorchBackend",
    "NerfPytorchConfig",
    "NerfPytorchField",
    "backend",
    "read_checkpoint",
]


class NerfPytorchBackend:
    """What the entry point names."""

    summary = "coarse and fine networks as krrish94/nerf-pytorch trains them; reads its checkpoints"
    config_type = NerfPytorchConfig

    def build(self, config: NerfPytorchConfig, bounds: SceneBounds) -> NerfPytorchField:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(config.seed)
            return NerfPytorchField(config, bounds)

    def train(
        self, field: NerfPytorchField, views: Sequence[View], config: NerfPytorchConfig, report: Report
    ) -> None:
        train(field, views, config, report)


backend = NerfPytorchBackend()
