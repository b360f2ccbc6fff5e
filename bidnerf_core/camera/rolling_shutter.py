"""Rolling shutters: the rows of an image are exposed one after another, while the camera moves.

The motion is the right update (metres, then radians, in the camera's frame) of the camera's pose from the first row to the
last, at a constant velocity; the pose itself refers to the middle row (Hedborg et al., Rolling shutter bundle adjustment,
CVPR 2012).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.camera.intrinsics import Intrinsics
from bidnerf_core.geometry import SE3


@dataclass(frozen=True)
class MotionPrior:
    """Standard deviations of the camera's motion from the first row to the last, per axis."""

    move: float = 0.0  # metres
    turn: float = 0.0  # radians

    @property
    def deviations(self) -> Float[Tensor, "6"]:
        return torch.tensor([self.move] * 3 + [self.turn] * 3, dtype=torch.float64)

    @staticmethod
    def usual(distance: float) -> MotionPrior:
        """Return the prior for a hand-held camera at ``distance`` (metres) from the scene.

        The readout is assumed to take a few hundredths of a second.
        """
        return MotionPrior(0.005 * distance, 0.01)


AT_REST = torch.zeros(6, dtype=torch.float64)
"""The motion of a camera at rest."""
STILL = MotionPrior()
"""The prior of a static camera or a global shutter."""


def exposure_times(pixels: Float[Tensor, "m 2"], camera: Intrinsics) -> Float[Tensor, "m"]:
    """Return each pixel's exposure time as a fraction of the readout time: -0.5 to 0.5, zero at the middle row.

    Sensors are wider than they are high, so the sensor's rows are the columns of a portrait image; square
    images count as landscape. The direction of the readout does not matter: reversing it reverses the motion.
    """
    axis = 0 if camera.height > camera.width else 1
    return pixels[:, axis].double() / (camera.width, camera.height)[axis] - 0.5


def poses_of_rows(times: Float[Tensor, "m"], motion: Float[Tensor, "*m 6"]) -> SE3:
    """Return T_middle_row: the camera's pose at each time, relative to the camera at the middle row.

    ``motion`` (metres, then radians) is for a single image, or has one row per time.
    """
    return SE3.exp(times[:, None] * motion.to(times))
