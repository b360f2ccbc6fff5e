"""What training recipes share: batches of rays, losses, the loop with its schedule, checkpoints and resumption."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Float, Int
from torch import Generator, Tensor, nn

from bidnerf_core.errors import InputError
from bidnerf_core.field import Rays, SceneBounds
from bidnerf_core.frames import SPARSE, View
from bidnerf_core.rendering import Rendering

MEASURED_SHARE = 0.25
"""Of the rays of a batch, at measured pixels, where these are so few that hardly any would be drawn (in DS-NeRF: half)."""


@dataclass(frozen=True)
class Progress:
    """One step of training, for display."""

    step: int
    total: int
    loss: float
    psnr: float
    samples_per_ray: float = float("nan")


@dataclass(frozen=True)
class TrainingState:
    """All that is needed to go on as if nothing had happened."""

    step: int
    field: dict[str, Tensor]
    optimizer: dict[str, Tensor]  # Adam's moments, the generator


@runtime_checkable
class Report(Protocol):
    """Whom a recipe tells of its progress, and who keeps its state."""

    def resume(self) -> TrainingState | None:
        """The state to go on from, if any."""
        ...

    def step(self, progress: Progress) -> None: ...

    def due(self, step: int) -> bool:
        """Whether ``save`` is wanted after this step."""
        ...

    def save(self, state: TrainingState) -> None: ...

    @property
    def stopping(self) -> bool:
        """Whether to save and stop after the current step."""
        ...


class Silent:
    """A report that nobody reads: no display, no checkpoints."""

    stopping = False

    def resume(self) -> TrainingState | None:
        return None

    def step(self, progress: Progress) -> None:
        pass

    def due(self, step: int) -> bool:
        return False

    def save(self, state: TrainingState) -> None:
        pass


class TrainingStopped(Exception):
    """Training was asked to stop; its state was saved at ``step``."""

    def __init__(self, step: int) -> None:
        super().__init__(f"training stopped after step {step}")
        self.step = step


@dataclass(frozen=True, eq=False)
class RayBatch:
    """Rays of training views and what was seen along them."""

    rays: Rays
    rgb: Float[Tensor, "r 3"]
    distance: Float[Tensor, "r"]  # metres along the ray, 0 where nothing was measured
    background: Float[Tensor, "r 3"]


class RayBank:
    """All pixels of the training views, to draw batches from.

    Where an image has an alpha channel, its background is replaced by a random colour in each batch: a field then cannot
    explain the background by matter of that colour (Mueller et al. 2022, as in their code).
    """

    def __init__(self, views: Sequence[View], bounds: SceneBounds) -> None:
        self.bounds = bounds
        frames = [view.frame for view in views]
        sizes = torch.tensor([frame.rgb.shape[0] * frame.rgb.shape[1] for frame in frames])
        self.offsets = sizes.cumsum(0) - sizes
        self.count = int(sizes.sum())
        self.has_alpha = any(frame.alpha is not None for frame in frames)
        self.has_depth = any(frame.has_depth for frame in frames)
        self._rgb = torch.cat([frame.rgb.reshape(-1, 3) for frame in frames])
        if self.has_alpha:
            one = [torch.ones(f.rgb.shape[:2]) if f.alpha is None else f.alpha for f in frames]
            self._alpha = torch.cat([a.reshape(-1) for a in one])
        if self.has_depth:
            zero = [torch.zeros(f.rgb.shape[:2]) if f.depth is None else f.depth for f in frames]
            self._depth = torch.cat([d.reshape(-1) for d in zero])
        self._few = self._few_measured()
        self._rotation = torch.stack([view.T_ref_camera.rotation for view in views]).float()
        self._origin = torch.stack([view.T_ref_camera.translation for view in views]).float()
        kinds = list(dict.fromkeys(frame.intrinsics for frame in frames))
        grids = [kind.unproject(kind.pixel_centres()).reshape(-1, 3) for kind in kinds]
        starts = torch.tensor([0, *[len(grid) for grid in grids]]).cumsum(0)
        self._camera_rays = torch.cat(grids)  # z = 1
        self._camera_start = torch.stack([starts[kinds.index(frame.intrinsics)] for frame in frames])

    def draw(self, count: int, generator: Generator) -> RayBatch:
        """``count`` pixels of all views, uniformly; some of them where depth was measured, if that is in few places."""
        index = torch.randint(self.count, (count,), generator=generator)
        if len(self._few):
            some = round(MEASURED_SHARE * count)
            index[:some] = self._few[torch.randint(len(self._few), (some,), generator=generator)]
        view = torch.searchsorted(self.offsets, index, right=True) - 1
        ray = self._camera_rays[self._camera_start[view] + index - self.offsets[view]]
        length = torch.linalg.vector_norm(ray, dim=-1)
        directions = (self._rotation[view] @ (ray / length[:, None])[..., None])[..., 0]
        distance = self._depth[index] * length if self.has_depth else torch.zeros(count)
        rgb, background = self._coloured(index, generator)
        return RayBatch(self.bounds.rays(self._origin[view], directions), rgb, distance, background)

    def _few_measured(self) -> Int[Tensor, "m"]:
        """Indices of the pixels with depth, where those are a few points of all (structure from motion); else none."""
        if not self.has_depth:
            return torch.zeros(0, dtype=torch.long)
        measured = (self._depth > 0).nonzero()[:, 0]
        return measured if len(measured) < SPARSE * self.count else measured[:0]

    def _coloured(self, index: Tensor, generator: Generator) -> tuple[Tensor, Tensor]:
        usual = torch.tensor(self.bounds.background).expand(len(index), 3)
        if not self.has_alpha:
            return self._rgb[index], usual
        background = torch.rand((len(index), 3), generator=generator)
        return self._rgb[index] + (1 - self._alpha[index])[:, None] * (background - usual), background


@dataclass(frozen=True, eq=False)
class StepOutcome:
    """What a recipe's step gives back to the loop."""

    loss: Float[Tensor, ""]
    mse: float  # of colours, for display
    samples_per_ray: float = float("nan")


def cosine(step: int, total: int, warmup: int = 100, last: float = 0.02) -> float:
    """Factor on the learning rate: linear warm-up, then half a cosine down to ``last``."""
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
) -> None:
    """Adam on parameter ``groups`` (each with its ``lr``), ``steps`` times ``outcome(step, generator)``.

    Resumes from ``report.resume()``; saves when ``report`` says that it is due; raises ``TrainingStopped`` after saving
    when it says stop. A resumed run computes what an uninterrupted one would have. Raises ``InputError`` where the loss is
    not finite.
    """
    optimizer = torch.optim.Adam(groups, betas=(0.9, 0.99), eps=1e-15, fused=True)
    rates = [group["lr"] for group in optimizer.param_groups]
    generator = torch.Generator().manual_seed(seed)
    first = _restore(report.resume(), field, optimizer, generator)
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
        report.step(Progress(step + 1, steps, loss, psnr, result.samples_per_ray))
        # Asked once: it may change at any time, and who is told to stop must have saved.
        stopping = report.stopping
        if stopping or report.due(step + 1):
            report.save(_state(step + 1, field, optimizer, generator))
        if stopping and step + 1 < steps:
            raise TrainingStopped(step + 1)


def _parameters(optimizer: torch.optim.Optimizer) -> Iterator[Tensor]:
    return (parameter for group in optimizer.param_groups for parameter in group["params"])


def _state(
    step: int, field: nn.Module, optimizer: torch.optim.Optimizer, generator: Generator
) -> TrainingState:
    moments = {"generator": generator.get_state()}
    for number, parameter in enumerate(_parameters(optimizer)):
        for name, value in optimizer.state.get(parameter, {}).items():
            moments[f"{number}.{name}"] = value
    return TrainingState(step, dict(field.state_dict()), moments)


def _restore(
    state: TrainingState | None, field: nn.Module, optimizer: torch.optim.Optimizer, generator: Generator
) -> int:
    if state is None:
        return 0
    field.load_state_dict(state.field)
    generator.set_state(state.optimizer["generator"])
    for number, parameter in enumerate(_parameters(optimizer)):
        prefix = f"{number}."
        found = {k[len(prefix) :]: v.clone() for k, v in state.optimizer.items() if k.startswith(prefix)}
        if found:
            optimizer.state[parameter] = found
    return state.step


def supervised_loss(
    rendering: Rendering, batch: RayBatch, side: float, depth_weight: float
) -> tuple[Float[Tensor, ""], float]:
    """Squared error of colour plus ``depth_weight`` times the depth term; and the colour term alone, for display.

    The depth term is the mean distance, in parts of ``side`` (metres), of each ray's weight from where its depth was
    measured: like the ray termination loss of DS-NeRF (Deng et al. 2022) it wants all weight there, and unlike an error
    of the mean depth it is not content with weight on both sides. Weight that a ray lacks counts as if at the camera.
    """
    error = (rendering.rgb - batch.rgb) ** 2
    mse = float(error.detach().mean())
    return error.mean() + depth_weight * depth_term(rendering, batch) / side, mse


def depth_term(rendering: Rendering, batch: RayBatch) -> Float[Tensor, ""]:
    """Metres, mean over the rays whose depth was measured; 0 where there are none."""
    measured = batch.distance > 0
    away = (rendering.weights * (rendering.samples.middles - batch.distance[:, None]).abs()).sum(-1)
    missing = (1 - rendering.opacity) * batch.distance
    return torch.where(measured, away + missing, 0).sum() / measured.sum().clamp(min=1)
