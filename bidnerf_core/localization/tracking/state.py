"""The state that a tracker keeps between frames."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import partial

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from bidnerf_core.camera import Intrinsics
from bidnerf_core.frames import Frame
from bidnerf_core.localization.tracking.motion import Clock, Motion
from bidnerf_core.localization.tracking.points import Points
from bidnerf_core.mapping import true_intrinsics


@dataclass(frozen=True, eq=False)
class TrackerState:
    """The complete state of a tracker between frames."""

    clock: Clock
    motion: Motion | None = None  # None until a first pose is found
    frames: int = 0  # number of frames so far
    lost: int = 0  # consecutive frames without an accepted pose, up to the last one
    searchable: int = 0  # number of these frames for which the map could be searched
    points: Points = field(default_factory=Points.none)
    image: UInt8[Tensor, "h w"] | None = None  # the last one, grey, in which the points were observed
    sought: int = 0  # number of landmarks when they were last recognised
    age: int = 0  # frames since then
    moves: bool = False  # whether the camera moved during the readout of the last image
    # Corrections of the stated camera (see ``NUISANCES``) that a search found, for frames whose focal length is of the same kind.
    camera: Float[Tensor, "6"] = field(default_factory=partial(torch.zeros, 6, dtype=torch.float64))
    is_approximate: bool = False  # whether that kind is an approximate focal length
    # Covariance of the pose due to errors of the intrinsics.
    doubt: Float[Tensor, "6 6"] = field(default_factory=partial(torch.zeros, 6, 6, dtype=torch.float64))

    def correct(self, frame: Frame) -> Frame:
        """Return a frame with its camera corrected; unchanged if the correction suits only exact, or only approximate, focal lengths."""
        if frame.focal_is_approximate != self.is_approximate or not bool(self.camera.any()):
            return frame
        return frame.replace(intrinsics=true_intrinsics(frame.intrinsics, self.camera))


def invert_correction(stated: Intrinsics, true: Intrinsics) -> Float[Tensor, "6"]:
    """Return the correction with which ``true_intrinsics`` turns ``stated`` into ``true``, exactly (focal lengths, centre and k1 only).

    ``correction_between``, which compares any two cameras by their pixels, is only an approximation for distorted images.
    """
    across, down = true.fx / stated.fx, true.fy / stated.fy
    bent = [camera.distortion[0] if camera.distortion else 0.0 for camera in (true, stated)]
    centre = (true.cx - stated.cx) / stated.fx, (true.cy - stated.cy) / stated.fy
    values = [math.log(across * down) / 2, *centre, bent[0] - bent[1], math.log(across / down), 0.0]
    return torch.tensor(values, dtype=torch.float64)
