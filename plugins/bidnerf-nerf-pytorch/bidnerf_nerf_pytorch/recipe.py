"""How the two networks are trained, from the start or from a checkpoint on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path

from torch import Generator

from bidnerf_core.errors import InputError
from bidnerf_core.frames import View
from bidnerf_core.rendering import render
from bidnerf_core.training import RayBank, Report, StepOutcome, fit, supervised_loss
from bidnerf_nerf_pytorch.checkpoint import read_checkpoint
from bidnerf_nerf_pytorch.field import FieldConfig, NerfPytorchField
from bidnerf_nerf_pytorch.network import NetworkConfig

LEAST = {
    "layers": 1, "width": 2, "position_frequencies": 0, "direction_frequencies": 0, "coarse_samples": 1,
    "fine_samples": 1, "steps": 1, "rays_per_step": 1, "learning_rate": 0, "depth_weight": 0, "seed": 0,
}  # fmt: skip


@dataclass(frozen=True)
class NerfPytorchConfig(FieldConfig):
    """Architecture and training. The defaults are those of the checkpoints that nerf-pytorch offers."""

    steps: int = 200_000  # of the optimizer
    rays_per_step: int = 1024
    learning_rate: float = 5e-3
    depth_weight: float = (
        0.1  # of the depth term beside the colour term, where there is depth; 0 leaves depth out
    )
    seed: int = 0  # of initial weights and of all that is drawn at random
    checkpoint: str = ""  # file whose weights training starts from; "" starts from chance

    def __post_init__(self) -> None:
        for name, least in LEAST.items():
            value = getattr(self, name)
            if not value >= least:
                raise InputError(f"{name} is {value}, expected {least} or more")
        for kind in ("position", "direction"):
            if not (getattr(self, f"{kind}_frequencies") or getattr(self, f"{kind}_input")):
                raise InputError(f"{kind}_frequencies is 0 without {kind}_input, expected one of them")


def train(field: NerfPytorchField, views: Sequence[View], config: NerfPytorchConfig, report: Report) -> None:
    """Fit ``field`` to ``views``; see ``fit`` for checkpoints and stopping."""
    if config.checkpoint and report.resume() is None:
        _start_from(Path(config.checkpoint), field)
    bank = RayBank(views, field.bounds)
    side = max(field.bounds.size)

    def outcome(step: int, generator: Generator) -> StepOutcome:
        batch = bank.draw(config.rays_per_step, generator)
        coarse, fine = (render(level, batch.rays, batch.background, generator) for level in field.levels)
        rough, _ = supervised_loss(coarse, batch, side, config.depth_weight)
        loss, mse = supervised_loss(fine, batch, side, config.depth_weight)
        return StepOutcome(rough + loss, mse, float(fine.samples.valid.sum() / len(batch)))

    groups = [{"params": list(field.parameters()), "lr": config.learning_rate}]
    fit(field, groups, outcome, config.steps, report, seed=config.seed)


def _start_from(path: Path, field: NerfPytorchField) -> None:
    checkpoint = read_checkpoint(path, field.config.octaves)
    for each in fields(NetworkConfig):
        found, expected = getattr(checkpoint.network, each.name), getattr(field.config, each.name)
        if found != expected:
            raise InputError(f"{path}: its networks have {each.name} {found}, the config says {expected}")
    field.load_state_dict(checkpoint.tensors)
