"""The way that a descent took: its poses and losses, when to stop on it, and which pose of it to answer with."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.se3 import SE3

WINDOW = 20
"""Steps over which the noisy loss is averaged before it is trusted."""

AnswerName = Literal["last", "best"]


@dataclass(eq=False)
class Trail:
    """Poses from the start on, and the loss that was found at each but the last."""

    poses: list[SE3]
    losses: list[float] = field(default_factory=list)

    @property
    def T(self) -> SE3:
        """Where the descent is."""
        return self.poses[-1]

    def recent_loss(self) -> float:
        """Mean of the last ``WINDOW`` losses; NaN where there are none."""
        last = self.losses[-WINDOW:]
        return sum(last) / len(last) if last else math.nan

    def recent_step(self) -> float:
        """Mean size of the last ``WINDOW`` steps: the length of their tangent vectors, metres and radians alike."""
        if len(self.poses) < 2:
            return math.inf
        way = SE3.stack(self.poses[-WINDOW - 1 :])
        return float((way[:-1].inverse() @ way[1:]).log().norm(dim=-1).mean())

    def stop(self, loss_below: float, step_below: float) -> str | None:
        """Why to stop, if there is a reason; a bar of 0 is never reached."""
        if len(self.losses) < WINDOW:
            return None
        if self.recent_loss() < loss_below:
            return f"mean loss of {WINDOW} steps fell below {loss_below:g}"
        if step_below > 0 and self.recent_step() < step_below:
            return f"mean length of {WINDOW} steps fell below {step_below:g}"
        return None

    def answer(self, name: AnswerName) -> tuple[SE3, float]:
        """A pose and the mean loss of the steps up to it.

        ``last`` is the last pose, ``best`` the pose at the end of the ``WINDOW`` losses whose mean is least, or the last one
        of a way shorter than that: a single loss is that of a few pixels, and says little.
        """
        if name == "last" or len(self.losses) < WINDOW:
            return self.T, self.recent_loss()
        means = _moving_mean(torch.tensor(self.losses, dtype=torch.float64))
        least = int(means.argmin())
        return self.poses[least + WINDOW - 1], float(means[least])


def _moving_mean(values: Float[Tensor, "s"]) -> Float[Tensor, "m"]:
    """Of ``WINDOW`` values each."""
    return values.unfold(0, WINDOW, 1).mean(-1)
