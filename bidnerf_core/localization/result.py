"""What a localization gives back, whatever the method."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from bidnerf_core.se3 import SE3


@dataclass(frozen=True, eq=False)
class Localization:
    """The pose found for the last view's camera, and how it was found."""

    T_world_camera: SE3
    converged: bool  # the method's own judgement, made without knowing the truth
    reason: str  # why it stopped
    steps: int
    seconds: float
    loss: float
    method: str
    poses: (
        SE3  # (steps + 1): the start, or the hypothesis that led to the answer, then the pose after each step
    )
    losses: Float[Tensor, "s"]  # after the start and before each step
    covariance: Float[Tensor, "6 6"] | None = (
        None  # of a right update: translation in metres, rotation in radians
    )
