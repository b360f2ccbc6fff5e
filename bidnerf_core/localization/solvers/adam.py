"""First-order descent: Adam on updates of one pose (Alg. 1 of the paper, its loop test the right way round)."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from bidnerf_core.localization.method_settings import AdamSettings
from bidnerf_core.localization.pivots import Pivot
from bidnerf_core.localization.solvers.history import WINDOW, History
from bidnerf_core.se3 import SE3
from bidnerf_core.waiting import without_waiting

Loss = Callable[[SE3], Tensor]


class AdamSteps:
    """Steps of one pose, on its own device: no step reads a number from it, or copies anything from or to it.

    Each step writes the pose as an update delta of the current one about ``pivot``, takes the gradient by delta at 0, and
    moves by what Adam makes of it. A step that is not finite leaves the pose where it is.
    """

    def __init__(self, loss: Loss, pivot: Pivot, config: AdamSettings, start: SE3) -> None:
        self.T, self._loss, self._config = start, loss, config
        device = start.translation.device
        self._pivot = pivot.to(device)
        self._delta = [torch.zeros(3, dtype=torch.float64, device=device).requires_grad_() for _ in range(2)]
        self._rates = (config.learning_rate, config.learning_rate / pivot.reach)
        groups = [{"params": [x], "lr": rate} for x, rate in zip(self._delta, self._rates, strict=True)]
        self._optimizer = torch.optim.Adam(groups, betas=(0.9, 0.999))

    def __call__(self, step: int) -> tuple[Tensor, Tensor]:
        """Take a step, and return the loss before it, and whether the pose after it is finite."""
        rho, phi = self._delta
        fade = self._config.decay ** (step / self._config.decay_steps)
        for group, rate in zip(self._optimizer.param_groups, self._rates, strict=True):
            group["lr"] = rate * fade
        value = self._loss(self._pivot.moved(self.T, torch.cat([rho, phi])))
        if value.requires_grad:  # it does not where no ray meets anything
            rho.grad, phi.grad = torch.autograd.grad(value, (rho, phi))
            self._optimizer.step()
        with torch.no_grad():
            moved = self._pivot.moved(self.T, torch.cat([rho, phi])).polished()
            finite = moved.rotation.isfinite().all() & moved.translation.isfinite().all()
            self.T = SE3(
                torch.where(finite, moved.rotation, self.T.rotation),
                torch.where(finite, moved.translation, self.T.translation),
            )
            rho.zero_()
            phi.zero_()
        return value.detach(), finite


def follow_gradient(
    loss: Loss, pivot: Pivot, config: AdamSettings, history: History, device: torch.device
) -> tuple[bool, str]:
    """Take steps from ``history.T``, record them, and return whether they stayed finite and why they ended.

    Steps are taken on ``device``, ``WINDOW`` at a time; the host reads them after each block. If a reason to stop arose
    within a block, the steps after it are forgotten.
    """
    steps = AdamSteps(loss, pivot, config, history.T.to(device))
    for first in range(0, config.max_steps, WINDOW):
        poses, losses, finite = [], [], []
        with without_waiting():
            for step in range(first, min(first + WINDOW, config.max_steps)):
                value, sound = steps(step)
                poses.append(steps.T)
                losses.append(value)
                finite.append(sound)
        reason = _recorded(history, config, SE3.stack(poses).to("cpu"), losses, finite)
        if reason is not None:
            return reason
    return True, f"reached {config.max_steps} steps"


def _recorded(
    history: History, config: AdamSettings, poses: SE3, losses: list[Tensor], finite: list[Tensor]
) -> tuple[bool, str] | None:
    """Add a block of steps to the history, up to the first at which to stop; return whether all is finite, and why to stop."""
    values, sound = torch.stack(losses).double().tolist(), torch.stack(finite).tolist()
    for number, (value, is_finite) in enumerate(zip(values, sound, strict=True)):
        step = len(history.losses) + 1
        if not math.isfinite(value):
            return False, f"the loss was {value} at step {step}"
        history.losses.append(value)
        if not is_finite:
            return False, f"the step was not finite at step {step}"
        history.poses.append(poses[number].normalized())
        enough = history.stop(config.stop_loss, config.stop_step)
        if enough is not None:
            return True, enough
    return None
