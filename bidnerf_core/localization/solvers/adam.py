"""First-order descent: Adam on updates of one pose (Alg. 1 of the paper, its loop test the right way round)."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from bidnerf_core.localization.method_settings import AdamSettings
from bidnerf_core.localization.pivots import Pivot
from bidnerf_core.localization.solvers.history import History
from bidnerf_core.se3 import SE3

Loss = Callable[[SE3], Tensor]


def follow_gradient(loss: Loss, pivot: Pivot, config: AdamSettings, history: History) -> tuple[bool, str]:
    """Take steps from ``history.T``, record them, and return whether they stayed finite and why they ended.

    Each step writes the pose as an update delta of the current one about ``pivot``, takes the gradient by delta at 0, and
    moves by what Adam makes of it.
    """
    rho, phi = (torch.zeros(3, dtype=torch.float64, requires_grad=True) for _ in range(2))
    rates = (config.learning_rate, config.learning_rate / pivot.reach)
    groups = [{"params": [part], "lr": rate} for part, rate in zip((rho, phi), rates, strict=True)]
    optimizer = torch.optim.Adam(groups, betas=(0.9, 0.999))
    for step in range(config.max_steps):
        for group, rate in zip(optimizer.param_groups, rates, strict=True):
            group["lr"] = rate * config.decay ** (step / config.decay_steps)
        value = loss(pivot.moved(history.T, torch.cat([rho, phi])))
        if not math.isfinite(float(value.detach())):
            return False, f"the loss was {float(value.detach())} at step {step + 1}"
        history.losses.append(float(value.detach()))
        if value.requires_grad:  # it does not where no ray meets anything
            rho.grad, phi.grad = torch.autograd.grad(value, (rho, phi))
            optimizer.step()
        moved = pivot.moved(history.T, torch.cat([rho, phi]).detach())
        if not bool(moved.matrix().isfinite().all()):
            return False, f"the step was not finite at step {step + 1}"
        history.poses.append(moved.normalized())
        with torch.no_grad():
            rho.zero_()
            phi.zero_()
        enough = history.stop(config.stop_loss, config.stop_step)
        if enough is not None:
            return True, enough
    return True, f"reached {config.max_steps} steps"
