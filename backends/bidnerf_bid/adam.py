"""First-order descent: Adam on updates of one pose (Alg. 1 of the paper, with its loop condition corrected)."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from jaxtyping import Bool, Float
from torch import Generator, Tensor

from bidnerf_bid.pivot import Pivot
from bidnerf_bid.settings import AdamSettings
from bidnerf_core.devices import capture_graph, constant, move_to, without_waiting
from bidnerf_core.geometry import SE3
from bidnerf_core.progress import check_cancelled

WINDOW = 20
"""Number of steps over which the noisy loss of randomly drawn rays is averaged."""
Loss = Callable[[SE3], Tensor]
RATE = 0.0125
"""Default learning rate: for translations as a fraction of the distance to the pivot, for rotations in radians."""
BETAS = (0.9, 0.999)
"""Decay rates of the moments (Kingma and Ba 2015, Alg. 1)."""


class AdamSteps:
    """Adam optimization of one pose on its device; no step copies data between host and device.

    Each step parametrizes the pose by an update delta of the current pose about ``pivot``, takes the gradient with respect to
    delta at 0, and applies Adam's update. A non-finite step leaves the pose unchanged. All state is kept in tensors that are updated
    in place, so each replay of a captured CUDA graph takes the next step.
    """

    def __init__(self, loss: Loss, pivot: Pivot, config: AdamSettings, start: SE3) -> None:
        device = start.translation.device
        self._loss, self._pivot, self._config = loss, move_to(pivot, device), config
        lever = pivot.lever_arm
        length = RATE * lever if config.learning_rate is None else config.learning_rate
        self._rate = torch.tensor([length] * 3 + [length / lever] * 3, dtype=torch.float64).to(device)
        self._T = SE3(start.rotation.clone(), start.translation.clone())
        self._steps, self._updates = (torch.zeros((), dtype=torch.float64, device=device) for _ in range(2))
        self._mean, self._square = (torch.zeros(6, dtype=torch.float64, device=device) for _ in range(2))
        # Pose, loss before the step, and whether the step was finite.
        self._log = torch.zeros(WINDOW, 14, dtype=torch.float64, device=device)

    @property
    def T(self) -> SE3:
        """The current pose."""
        return SE3(self._T.rotation.clone(), self._T.translation.clone())

    def __call__(self) -> None:
        """Take one optimization step."""
        delta = torch.zeros_like(self._rate).requires_grad_()
        value = self._loss(self._pivot.move_linearly(self._T, delta))
        update = torch.zeros_like(delta)
        if value.requires_grad:  # false if no ray hits anything
            (gradient,) = torch.autograd.grad(value, delta)
            update = self._update(gradient)
        with torch.no_grad():
            there = self._pivot.move(self._T, update).polished()
            finite = there.rotation.isfinite().all() & there.translation.isfinite().all()
            for now, then in ((self._T.rotation, there.rotation), (self._T.translation, there.translation)):
                now.copy_(torch.where(finite, then, now))
            pose = torch.cat([self._T.rotation.flatten(), self._T.translation])
            row = torch.cat([pose, torch.stack([value.detach().to(pose), finite.to(pose)])])
            self._log.index_copy_(0, (self._steps % WINDOW).long()[None], row[None])
            self._steps += 1

    def block(self) -> tuple[SE3, Float[Tensor, "s"], Bool[Tensor, "s"]]:
        """Return, on the CPU, the poses after the last ``WINDOW`` steps, the loss before each step, and whether each step was finite.

        Call this method after every ``WINDOW`` steps; rows for steps not yet taken still hold earlier steps.
        """
        log = self._log.to("cpu", copy=True)  # later steps overwrite it
        return SE3(log[:, :9].unflatten(1, (3, 3)), log[:, 9:12]), log[:, 12], log[:, 13] > 0

    @torch.no_grad()
    def _update(self, gradient: Float[Tensor, "6"]) -> Float[Tensor, "6"]:
        """Return the step of Adam (Kingma and Ba 2015, Alg. 1), whose learning rate decays with the number of steps."""
        self._updates += 1
        first, second = BETAS
        self._mean.lerp_(gradient, 1 - first)
        self._square.mul_(second).addcmul_(gradient, gradient, value=1 - second)
        decays = constant(BETAS, self._updates)
        bias, bias_of_square = (1 - decays**self._updates).unbind()
        fade = constant((self._config.decay,), self._steps)[0] ** (self._steps / self._config.decay_steps)
        root = self._square.sqrt() / bias_of_square.sqrt() + 1e-8
        return -self._rate * fade / bias * (self._mean / root)


def follow_gradient(
    loss: Loss,
    pivot: Pivot,
    config: AdamSettings,
    start: SE3,
    device: torch.device,
    generator: Generator | None = None,
) -> tuple[list[SE3], list[float], bool, str]:
    """Descend from ``start``; return all poses, the loss before each step, whether all steps were finite, and why the descent ended.

    Steps are taken on ``device``, ``WINDOW`` at a time; the host reads the results after each block. If a stopping criterion was met
    within a block, the steps after it are discarded. Pass the ``generator`` that the loss draws from if every call does the same
    computation except for the random numbers: on a GPU, a step is then captured once and replayed.
    """
    steps = AdamSteps(loss, pivot, config, start.to(device))
    take: Callable[[], None] = steps
    poses, losses = [start], list[float]()
    for first in range(0, config.max_steps, WINDOW):
        check_cancelled()
        count = min(WINDOW, config.max_steps - first)
        with without_waiting():
            for step in range(count):
                # Three steps before the capture fill caches and load kernels, which a capture does not allow.
                if generator is not None and first + step == 3:
                    take = capture_graph(steps, device, generator)
                take()
        T, values, finite = steps.block()
        for number in range(count):
            value, step = float(values[number]), len(losses) + 1
            if not math.isfinite(value):
                return poses, losses, False, f"the loss was {value} at step {step}"
            losses.append(value)
            if not finite[number]:
                return poses, losses, False, f"the step was not finite at step {step}"
            poses.append(T[number].normalized())
            if step >= WINDOW and recent_loss(losses) < config.stop_loss:
                why = f"mean loss of {WINDOW} steps fell below {config.stop_loss:g}"
                return poses, losses, True, why
    return poses, losses, True, f"reached {config.max_steps} steps"


def recent_loss(losses: list[float]) -> float:
    """Return the mean of the last ``WINDOW`` losses; NaN if there are none."""
    last = losses[-WINDOW:]
    return sum(last) / len(last) if last else math.nan
