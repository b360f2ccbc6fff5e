"""The history of a descent: its poses and losses, the stopping criteria, and the choice of the resulting pose."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.geometry import SE3

WINDOW = 20
"""Steps over which the noisy loss of a few rays is averaged."""

AnswerName = Literal["last", "best"]


@dataclass(eq=False)
class History:
    """Poses from the start on, and the loss at each but the last."""

    poses: list[SE3]
    losses: list[float] = field(default_factory=list)

    @property
    def T(self) -> SE3:
        """The current pose."""
        return self.poses[-1]

    def add_batch(self, poses: SE3, costs: Float[Tensor, "t h"]) -> None:
        """Add the best pose after each step of a batch: ``poses`` (t h) and their costs, the first before any step."""
        best = costs.argmin(-1).tolist()
        self.poses += [poses[i, best[i]] for i in range(1, len(best))]
        self.losses += (costs.amin(-1)[:-1] / 2).tolist()

    def recent_loss(self) -> float:
        """Return the mean of the last ``WINDOW`` losses; NaN if there are none."""
        last = self.losses[-WINDOW:]
        return sum(last) / len(last) if last else math.nan

    def recent_step(self) -> float:
        """Return the mean length of the last ``WINDOW`` steps' tangent vectors, metres and radians alike."""
        if len(self.poses) < 2:
            return math.inf
        way = SE3.stack(self.poses[-WINDOW - 1 :])
        return float((way[:-1].inverse() @ way[1:]).log().norm(dim=-1).mean())

    def stop(self, loss_below: float, step_below: float) -> str | None:
        """Return the reason to stop, or None; a threshold of 0 is never met."""
        if len(self.losses) < WINDOW:
            return None
        if self.recent_loss() < loss_below:
            return f"mean loss of {WINDOW} steps fell below {loss_below:g}"
        if step_below > 0 and self.recent_step() < step_below:
            return f"mean length of {WINDOW} steps fell below {step_below:g}"
        return None

    def answer(self, name: AnswerName) -> tuple[SE3, float]:
        """Return a pose and the mean loss of the steps up to it.

        ``last`` is the last pose. ``best`` is the pose at the end of the ``WINDOW`` steps with the smallest mean loss, since the
        loss of a single step is noisy; in a shorter history, it is the last pose.
        """
        if name == "last" or len(self.losses) < WINDOW:
            return self.T, self.recent_loss()
        means = torch.tensor(self.losses, dtype=torch.float64).unfold(0, WINDOW, 1).mean(-1)
        least = int(means.argmin())
        return self.poses[least + WINDOW - 1], float(means[least])
