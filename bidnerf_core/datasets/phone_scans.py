"""Common properties of phone scans: photos with lower-resolution lidar depth, and a pose for each frame.

ARKit's poses are camera to world with OpenGL axes and +y up, its intrinsics are relative to the centre of the
upper left pixel, and its confidence is 0 (low), 1 or 2 (high). Depth is kept where the confidence is high,
and up to the range of the lidar; beyond it, depth was inferred from the photo. Each pixel has the depth of
the nearest measurement. Photos with more than 640 pixels on the longer side are downscaled to that size, as
is their camera, unless the user gives another size (``reading_at``): a scan has hundreds of them.

Phones record up to 60 frames a second, far more than a map needs. The dataset of such a recording has five
frames a second, and the sequence all of them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol, TypeVar

import numpy as np
import torch
from jaxtyping import Integer, Shaped
from scipy.spatial.transform import Rotation
from torch import Tensor

from bidnerf_core.camera import CameraSource, Intrinsics, Raster
from bidnerf_core.datasets.incomplete import remark
from bidnerf_core.datasets.rgbd import largest_side
from bidnerf_core.datasets.trajectories import check_unit
from bidnerf_core.depth import DepthImage
from bidnerf_core.errors import InputError, amount, enumeration
from bidnerf_core.frames import Frame, fit_depth
from bidnerf_core.geometry import SE3
from bidnerf_core.io import reduced

LARGEST_SIDE = 640
"""Default limit of the pixels on a photo's longer side."""
LIDAR_RANGE = 5.0
"""Range of the lidar (metres) according to Apple."""
HIGH_CONFIDENCE = 2
MOST_VALUES = 4
"""Number of different confidences up to which a remark lists them."""
CENTRE_OF_PIXEL = 0.5
"""Added to principal points relative to the centre of the upper left pixel."""
FRAMES_PER_SECOND = 5.0
"""Largest frame rate of a dataset."""
ROUNDING = 0.005
"""Seconds by which frame times may be early."""


class Timed(Protocol):
    @property
    def time(self) -> float | None: ...


T = TypeVar("T", bound=Timed)


@dataclass(frozen=True)
class Measured:
    """Lidar depth, and the file that messages name."""

    depth: DepthImage
    where: str


def scan_frame(
    name: str,
    rgb: Shaped[Tensor, "h w 3"],
    camera: Intrinsics,
    depth: Measured | None,
    image: Path | str,
) -> Frame:
    """Build a frame from a photo and its depth, by default downscaled to ``LARGEST_SIDE`` pixels on the
    longer side.

    ``rgb`` is in [0, 1], or bytes as in ``read_compact_image``. ``camera`` is scaled to the photo. Raises
    ``InputError`` if the camera or depth has another aspect ratio.
    """
    raster = Raster(rgb.shape[1], rgb.shape[0])
    whole = CameraSource(camera).find(image, raster).intrinsics
    small = whole.scaled(min(1.0, (largest_side(LARGEST_SIDE) or math.inf) / max(raster.size)))
    pixels = rgb if small.width == raster.width else reduced(rgb, small.width, small.height)
    size = (small.width, small.height)
    metres = None if depth is None else fit_depth(depth.depth, raster, size, f"{depth.where}: depth")
    return Frame(name, pixels, small, metres)


class SureDepth:
    """Filters lidar depth by confidence, and remarks once that an image loses all of its depth."""

    def __init__(self) -> None:
        self._remarked = False

    def __call__(
        self,
        measured: DepthImage,
        confidence: Integer[np.ndarray, "h w"] | None,
        where: str,
        high: int = HIGH_CONFIDENCE,
    ) -> DepthImage:
        """Keep depth whose confidence, if there is any, is ``high``, and within the range of the lidar; 0
        elsewhere.

        Raises ``InputError``, whose message begins with ``where``, for a confidence of another size or with
        values above ``high``.
        """
        metres = torch.where(measured.metres <= LIDAR_RANGE, measured.metres, 0)
        if confidence is None:
            return replace(measured, metres=metres)
        if confidence.shape != tuple(metres.shape):
            found = "x".join(map(str, confidence.shape[::-1]))
            raise InputError(
                f"is {found}", where=where, expected=f"{metres.shape[1]}x{metres.shape[0]} like its depth"
            )
        if confidence.max() > high:
            raise InputError(
                f"has values up to {confidence.max()}", where=where, expected=f"confidences from 0 to {high}"
            )
        sure = torch.where(torch.from_numpy(confidence.astype(np.int64)) == high, metres, 0)
        if not self._remarked and bool(metres.any()) and not bool(sure.any()):
            self._remarked = True
            remark(
                where,
                f"{_values(confidence)}, expected {high} where depth is sure; without it, all depth"
                " of this image is left out, and so it is in such images that follow",
            )
        return replace(measured, metres=sure)


def _values(confidence: Integer[np.ndarray, "h w"]) -> str:
    """Return the values of a confidence image in words."""
    values = np.unique(confidence)
    if len(values) > MOST_VALUES:
        return f"has values from {values[0]} to {values[-1]}"
    return f"has {'only the value' if len(values) == 1 else 'the values'} {enumeration([str(v) for v in values])}"


def pose_of_numbers(where: str, numbers: Sequence[float], opengl: bool) -> SE3 | None:
    """Return ``T_world_camera`` (OpenCV axes) from a quaternion x y z w and a position, or None if they hold
    no pose.

    The camera axes are OpenGL's or OpenCV's. Raises ``InputError`` for a quaternion whose length is not 1.
    """
    length = math.hypot(*numbers[:4])
    if not all(map(math.isfinite, numbers)) or length == 0:
        return None
    check_unit(length, where, "qx qy qz qw")
    rotation = torch.from_numpy(Rotation.from_quat(np.array(numbers[:4])).as_matrix())
    if opengl:
        rotation = rotation * rotation.new_tensor([1.0, -1.0, -1.0])
    return SE3(rotation, torch.tensor(list(numbers[4:7]), dtype=torch.float64))


def thinned(where: Path, frames: Sequence[T]) -> tuple[list[T], list[T]]:
    """Return the frames of a dataset, at most ``FRAMES_PER_SECOND``, and the others; a remark counts them.

    ``frames`` are in chronological order. All are kept if any has no time.
    """
    times = [frame.time for frame in frames]
    if any(time is None for time in times):
        return list(frames), []
    kept, others, due = list[T](), list[T](), -math.inf
    for frame, time in zip(frames, times, strict=True):
        assert time is not None
        if time >= due:
            kept.append(frame)
            due = time + 1 / FRAMES_PER_SECOND - ROUNDING
        else:
            others.append(frame)
    if others:
        remark(
            where,
            f"the dataset has {len(kept)} of {amount(len(frames), 'frame')}, {FRAMES_PER_SECOND:g} per"
            " second; the sequence has all",
        )
    return kept, others
