"""Training of the two networks, from random weights or from a checkpoint."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated

from torch import Generator

from bidnerf_core.errors import InputError
from bidnerf_core.fields import device_of
from bidnerf_core.frames import View
from bidnerf_core.settings import Count, NotNegative, Range
from bidnerf_core.training import Report, StepOutcome, Supervision, SupervisionConfig
from bidnerf_nerf_pytorch.checkpoint import read_checkpoint
from bidnerf_nerf_pytorch.field import FieldConfig, NerfPytorchField
from bidnerf_nerf_pytorch.network import NetworkConfig


@dataclass(frozen=True)
class NerfPytorchConfig(FieldConfig, SupervisionConfig):
    """Architecture and training. The defaults are those of the checkpoints published by nerf-pytorch."""

    steps: Count = 200_000  # steps of the optimizer
    rays_per_step: Count = 1024  # number of rays per step
    learning_rate: NotNegative = 5e-3  # initial learning rate
    seed: Annotated[int, Range(0)] = 0  # seed of the initial weights and of all random draws
    checkpoint: str = ""  # file with the initial weights; "" for random ones

    def __post_init__(self) -> None:
        super().__post_init__()
        for kind in ("position", "direction"):
            if not (getattr(self, f"{kind}_frequencies") or getattr(self, f"{kind}_input")):
                raise InputError(f"{kind}_frequencies is 0 without {kind}_input", expected="one of them")


def train(field: NerfPytorchField, views: Sequence[View], config: NerfPytorchConfig, report: Report) -> None:
    """Fit ``field`` to ``views``; see ``fit`` on checkpoints and stopping."""
    if config.checkpoint and report.resume() is None:
        _start_from(Path(config.checkpoint), field)
    supervision = Supervision(views, field.bounds, config, device_of(field))

    def outcome(step: int, generator: Generator) -> StepOutcome:
        return supervision.step(field, config.rays_per_step, generator)

    groups = [{"params": list(field.parameters()), "lr": config.learning_rate}]
    supervision.fit(field, groups, outcome, config.steps, report, seed=config.seed)


def _start_from(path: Path, field: NerfPytorchField) -> None:
    checkpoint = read_checkpoint(path, field.config.octaves)
    for each in fields(NetworkConfig):
        found, expected = getattr(checkpoint.network, each.name), getattr(field.config, each.name)
        if found != expected:
            raise InputError(f"its networks have {each.name} {found}, but the config says {expected}", where=path)
    field.load_state_dict(checkpoint.tensors)
