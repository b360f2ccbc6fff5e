"""The training loop: Adam with a schedule, checkpoints and resumption."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Generator, Tensor, nn

from bidnerf_core.errors import InputError
from bidnerf_core.training.report import Report, TrainingState, TrainingStep, TrainingStopped

BESIDE = "beside."
"""Prefix of the names under which a state holds parameters learned jointly with the field."""


@dataclass(frozen=True, eq=False)
class StepOutcome:
    """The result of one step of a recipe."""

    loss: Float[Tensor, ""]
    mse: float  # of the colours, for display
    samples_per_ray: float = float("nan")


def cosine(step: int, total: int, warmup: int = 100, last: float = 0.02) -> float:
    """Return the factor on the learning rate: a linear warm-up, then half a cosine down to ``last``."""
    warmup = min(warmup, total // 10)
    if step < warmup:
        return (step + 1) / warmup
    done = (step - warmup) / max(1, total - warmup)
    return last + (1 - last) * 0.5 * (1 + math.cos(math.pi * min(1.0, done)))


def fit(
    field: nn.Module,
    groups: list[dict[str, Any]],
    outcome: Callable[[int, Generator], StepOutcome],
    steps: int,
    report: Report,
    schedule: Callable[[int, int], float] = cosine,
    seed: int = 0,
    beside: nn.Module | None = None,
) -> None:
    """Minimize the loss of ``outcome(step, generator)`` over parameter ``groups`` (each with its ``lr``) by ``steps`` of Adam.

    ``beside`` holds parameters that are learned with the field but not stored with it; they are among the
    groups. Training resumes from ``report.resume()``, saves when ``report.due`` returns True and, when
    ``report.stopping`` is set, saves and raises ``TrainingStopped``. A resumed run computes what an
    uninterrupted one would have; on a GPU, where sums have no fixed order, it does so up to rounding. The
    generator is on the CPU regardless of the field's device, so that the same rays are drawn everywhere.
    Raises ``InputError`` if the loss is not finite.
    """
    optimizer = torch.optim.Adam(groups, betas=(0.9, 0.99), eps=1e-15, fused=True)
    rates = [group["lr"] for group in optimizer.param_groups]
    generator = torch.Generator().manual_seed(seed)
    first = _restore(report.resume(), field, optimizer, generator, beside)
    for step in range(first, steps):
        for group, rate in zip(optimizer.param_groups, rates, strict=True):
            group["lr"] = rate * schedule(step, steps)
        optimizer.zero_grad(set_to_none=True)
        result = outcome(step, generator)
        loss = float(result.loss.detach())
        if not math.isfinite(loss):  # before it spreads to the weights, and from there to a checkpoint
            raise InputError(
                f"training diverged: loss {loss} at step {step + 1}; try a smaller learning rate"
            )
        result.loss.backward()
        optimizer.step()
        psnr = -10 * math.log10(max(result.mse, 1e-10))
        report.step(TrainingStep(step + 1, steps, loss, psnr, result.samples_per_ray))
        # Read it once: it may change at any time, and a training that stops must have saved its state.
        stopping = report.stopping
        if stopping or report.due(step + 1):
            report.save(_state(step + 1, field, optimizer, generator, beside))
        if stopping and step + 1 < steps:
            raise TrainingStopped(step + 1)


def _parameters(optimizer: torch.optim.Optimizer) -> Iterator[Tensor]:
    return (parameter for group in optimizer.param_groups for parameter in group["params"])


def _state(
    step: int,
    field: nn.Module,
    optimizer: torch.optim.Optimizer,
    generator: Generator,
    beside: nn.Module | None,
) -> TrainingState:
    moments = {"generator": generator.get_state()}
    if beside is not None:
        moments |= {BESIDE + name: value for name, value in beside.state_dict().items()}
    for number, parameter in enumerate(_parameters(optimizer)):
        for name, value in optimizer.state.get(parameter, {}).items():
            moments[f"{number}.{name}"] = value
    return TrainingState(step, dict(field.state_dict()), moments)


def _restore(
    state: TrainingState | None, field: nn.Module, optimizer: torch.optim.Optimizer, generator: Generator, beside: nn.Module | None
) -> int:  # fmt: skip
    if state is None:
        return 0
    field.load_state_dict(state.field)
    generator.set_state(state.optimizer["generator"])
    if beside is not None:
        found = {k.removeprefix(BESIDE): v for k, v in state.optimizer.items() if k.startswith(BESIDE)}
        beside.load_state_dict(found)
    for number, parameter in enumerate(_parameters(optimizer)):
        prefix = f"{number}."
        found = {
            name.removeprefix(prefix): value.to(parameter.device, copy=True)
            for name, value in state.optimizer.items()
            if name.startswith(prefix)
        }
        if found:
            optimizer.state[parameter] = found
    return state.step
