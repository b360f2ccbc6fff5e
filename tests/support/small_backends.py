"""The bundled backends with fields that train in milliseconds a step, and their trainings from a fixed seed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch

import tiny
from bidnerf.scenes import demo_object
from bidnerf_adanerf import AdaNerfConfig
from bidnerf_adanerf import backend as adanerf
from bidnerf_core.devices import move_to
from bidnerf_core.frames import View
from bidnerf_core.training import Report, Silent
from bidnerf_hashgrid import backend as hashgrid
from bidnerf_vanilla import VanillaConfig
from bidnerf_vanilla import backend as vanilla

BOUNDS = demo_object().bounds
VANILLA = VanillaConfig(
    layers=2,
    width=32,
    skip=1,
    position_frequencies=4,
    direction_frequencies=1,
    coarse_samples=16,
    fine_samples=8,
    room_resolution=16,
    samples_per_step=2048,
    rays_at_most=256,
    learning_rate=0.01,
)
ADANERF = AdaNerfConfig(
    width=32,
    layers=2,
    position_frequencies=4,
    oracle_width=32,
    oracle_layers=2,
    ray_points=4,
    ray_frequencies=2,
    bins=16,
    max_samples=5,
    samples_per_step=4096,
    rays_at_most=256,
    learning_rate=0.02,
    room_resolution=16,
)
BACKENDS: dict[str, tuple[Any, Any]] = {
    "hashgrid": (hashgrid, tiny.config()),
    "vanilla": (vanilla, VANILLA),
    "adanerf": (adanerf, ADANERF),
}


def train_field(
    name: str, views: Sequence[View], report: Report | None = None, device: torch.device | str = "cpu", **changes: Any
) -> Any:
    """Return a field of a backend after 40 steps, or as ``changes`` of its settings have it."""
    backend, config = BACKENDS[name]
    config = replace(config, **({"steps": 40, "carve": False} | changes))
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        field = move_to(backend.build(config, BOUNDS), device)
        backend.train(field, views, config, report or Silent())
    return field
