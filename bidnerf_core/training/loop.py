"""The training loop (Adam with a schedule, CUDA graphs, checkpoints and resumption), and reports of its progress."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Hashable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Generator, Tensor, nn
from torch.autograd.graph import increment_version

from bidnerf_core.devices import capture_graph, graph_memory, without_waiting
from bidnerf_core.errors import InputError


@dataclass(frozen=True)
class TrainingStep:
    """One step of training, for display."""

    step: int
    total: int
    loss: float
    psnr: float
    samples_per_ray: float = float("nan")


@dataclass(frozen=True)
class TrainingState:
    """The state needed to resume a training run as if it had not been interrupted."""

    step: int
    field: dict[str, Tensor]
    # Adam's moments, the state of the random generator, and parameters learned jointly with the field
    optimizer: dict[str, Tensor]


@runtime_checkable
class Report(Protocol):
    """Receives a recipe's progress and keeps its state; by default, it ignores both."""

    def resume(self) -> TrainingState | None:
        """Return the state to resume from, or None to start from scratch."""
        return None

    def step(self, progress: TrainingStep) -> None:
        """Receive the progress after each step."""

    def due(self, step: int) -> bool:
        """Return whether ``save`` should be called after this step."""
        return False

    def save(self, state: TrainingState) -> None:
        """Store the state."""

    @property
    def stopping(self) -> bool:
        """Whether to save and stop after the current step."""
        ...


class Silent(Report):
    """A report without display or checkpoints."""

    stopping = False


class TrainingStopped(Exception):
    """Training stopped on request; its state was saved at ``step``."""

    def __init__(self, step: int) -> None:
        super().__init__(f"training stopped after step {step}")
        self.step = step


READ_EVERY = 16
"""Number of steps on a GPU after which the host reads the loss and other figures; in between, it never waits."""


@dataclass(frozen=True, eq=False)
class StepOutcome:
    """The result of one step of a recipe. Numbers given as tensors are read when the host next waits for the device."""

    loss: Float[Tensor, ""]
    mse: float | Float[Tensor, ""]  # of the colours, for display
    samples_per_ray: float | Float[Tensor, ""] = float("nan")


@dataclass(frozen=True)
class Replayable:
    """An ``outcome`` function whose steps a GPU may replay as CUDA graphs, see ``fit``.

    ``prepare(step)`` is called before each step. It does the work that must not be part of a graph, such as reading numbers from
    the device, and returns a key: steps with equal keys launch the same operations on tensors of the same shapes, with the same
    scalar arguments. ``outcome(step, generator)`` draws from a generator on the field's device, must not wait for the device
    (see ``without_waiting``), and may be replayed for another step with the same key.
    """

    prepare: Callable[[int], Hashable]
    outcome: Callable[[int, Generator], StepOutcome]

    def __call__(self, step: int, generator: Generator) -> StepOutcome:
        """Return the outcome of a step that is neither captured nor replayed."""
        self.prepare(step)
        return self.outcome(step, generator)


def cosine(step: int, total: int, warmup: int = 100, last: float = 0.02) -> float:
    """Return the factor for the learning rate: a linear warm-up, then half a cosine down to ``last``."""
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
    """Minimize the loss of ``outcome(step, generator)`` over parameter ``groups`` (each with its ``lr``) by ``steps`` steps of Adam.

    ``beside`` holds parameters that are learned with the field but not stored with it; ``groups`` must include them. Training
    resumes from ``report.resume()``, saves when ``report.due`` returns True and, when ``report.stopping`` is set, saves and raises
    ``TrainingStopped``. A resumed run computes what an uninterrupted one would have; on a GPU, where sums have no fixed order, it
    does so up to rounding. Raises ``InputError`` if the loss is not finite.

    The generator is on the CPU regardless of the field's device, so that the same rays are drawn everywhere, unless ``outcome``
    is ``Replayable`` and the field on a GPU: then each step is a CUDA graph, and the report receives ``READ_EVERY`` steps at once.
    """
    optimizer = torch.optim.Adam(groups, betas=(0.9, 0.99), eps=1e-15, fused=True)
    rates = [group["lr"] for group in optimizer.param_groups]
    device = next(_parameters(optimizer)).device
    replayable = outcome if isinstance(outcome, Replayable) and device.type != "cpu" else None
    ahead = replayable is not None  # of the device, by up to READ_EVERY steps
    every = READ_EVERY if ahead else 1
    generator = torch.Generator(device if ahead else "cpu").manual_seed(seed)
    for group in optimizer.param_groups if ahead else []:
        group.update(lr=torch.full((), group["lr"], device=device), capturable=True)
    log, row = torch.zeros((every, 3), device=device), torch.zeros(1, dtype=torch.long, device=device)
    first = reported = _restore(report.resume(), field, optimizer, generator, beside)
    memory = graph_memory(device) if device.type == "cuda" else None
    graphs, seen = dict[Hashable, Callable[[], None]](), Counter[Hashable]()

    def take(step: int) -> None:
        optimizer.zero_grad(set_to_none=True)
        result = (outcome if replayable is None else replayable.outcome)(step, generator)
        if not ahead:
            _check_finite(float(result.loss.detach()), step)  # before it spreads to the weights
        result.loss.backward()
        optimizer.step()
        figures = (result.loss, result.mse, result.samples_per_ray)
        parts = [x.detach().to(log) if isinstance(x, Tensor) else log.new_full((), x) for x in figures]
        log.index_copy_(0, row, torch.stack(parts)[None])

    for step in range(first, steps):
        key = replayable and replayable.prepare(step)
        row.fill_(step % every)
        for group, rate in zip(optimizer.param_groups, rates, strict=True):
            factor = schedule(step, steps)
            group["lr"] = group["lr"].fill_(rate * factor) if ahead else rate * factor
        if not ahead:
            take(step)
        else:
            with without_waiting():
                seen[key] += 1
                # Two steps before the capture load kernels and create Adam's moments, which a capture does not allow.
                if seen[key] > 2 and key not in graphs:
                    graphs[key] = capture_graph(partial(take, step), device, generator, memory)
                graphs.get(key, partial(take, step))()
        if (step + 1) % every and step + 1 < steps:
            continue
        figures, stopping = log.tolist(), False
        for parameter in _parameters(optimizer):  # a replay does not increment their versions
            increment_version(parameter)
        for number in range(reported, step + 1):
            loss, mse, samples = figures[number % every]
            _check_finite(loss, number)  # before it spreads to a checkpoint
            report.step(TrainingStep(number + 1, steps, loss, -10 * math.log10(max(mse, 1e-10)), samples))
            # ``stopping`` is read only once, since it may change at any time, and training must not stop
            # without saving its state.
            stopping = report.stopping or stopping
        reported = step + 1
        if stopping or report.due(step + 1):
            report.save(_state(step + 1, field, optimizer, generator, beside))
        if stopping and step + 1 < steps:
            raise TrainingStopped(step + 1)


def _check_finite(loss: float, step: int) -> None:
    if not math.isfinite(loss):
        raise InputError(f"training diverged: loss {loss} at step {step + 1}; try a smaller learning rate")


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
        moments |= {f"beside.{name}": value for name, value in beside.state_dict().items()}
    states = (optimizer.state.get(parameter, {}) for parameter in _parameters(optimizer))
    moments |= {f"{number}.{name}": value for number, state in enumerate(states) for name, value in state.items()}
    return TrainingState(step, dict(field.state_dict()), moments)


def _restore(
    state: TrainingState | None,
    field: nn.Module,
    optimizer: torch.optim.Optimizer,
    generator: Generator,
    beside: nn.Module | None,
) -> int:
    if state is None:
        return 0
    field.load_state_dict(state.field)
    stored = state.optimizer["generator"]
    if stored.shape == generator.get_state().shape:
        generator.set_state(stored)
    else:  # the state is that of another kind of device
        generator.manual_seed(generator.initial_seed() + state.step)
    if beside is not None:
        beside.load_state_dict(_below("beside.", state.optimizer))
    for number, parameter in enumerate(_parameters(optimizer)):
        if moments := _below(f"{number}.", state.optimizer):
            optimizer.state[parameter] = {k: v.to(parameter.device, copy=True) for k, v in moments.items()}
    return state.step


def _below(prefix: str, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}
