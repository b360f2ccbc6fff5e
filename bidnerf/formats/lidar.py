"""Common properties of phone scans: photos with lower-resolution lidar depth, and a pose for each frame.

ARKit's poses are camera to world with OpenGL axes and +y up, its intrinsics are relative to the centre of the
upper left pixel, and its confidence is 0 (low), 1 or 2 (high). Depth is kept where the confidence is high,
and up to the range of the lidar; beyond it, depth was inferred from the photo. Each pixel has the depth of
the nearest measurement. Photos with more than 640 pixels on the longer side are downscaled to that size, and
so are their cameras, unless the user gives another size: a scan has hundreds of photos.

Phones record up to 60 frames a second, far more than a map needs. The dataset of such a recording has five
frames a second, and the sequence all of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Integer

from bidnerf_core.datasets import warn_about
from bidnerf_core.depth import MILLIMETRE, DepthImage, read_depth_image
from bidnerf_core.errors import InputError
from bidnerf_core.io import decode

LARGEST_SIDE = 640
"""Default limit on a photo's longer side (pixels)."""
HIGH_CONFIDENCE = 2
FRAMES_PER_SECOND = 5.0
"""Largest frame rate of a dataset."""
UP = (0.0, 1.0, 0.0)
"""The upward direction of ARKit's world, which is aligned with gravity."""


class LidarDepth:
    """Reads lidar depth of high confidence only, and issues one remark if an image loses all of its depth.

    ``scales`` holds the values that may denote high confidence, for apps that do not keep ARKit's values.
    """

    def __init__(self, scales: Sequence[int] = (HIGH_CONFIDENCE,)) -> None:
        self._scales, self._remarked = scales, False

    def __call__(self, depth: Path, confidence: Path | None) -> DepthImage:
        """Read a depth image stored in millimetres and its confidence image. Raises ``InputError`` as ``sure`` does."""
        measured = read_depth_image(depth, MILLIMETRE)
        sure = None if confidence is None else decode(confidence).astype(np.int64)
        if sure is not None and sure.ndim != 2:
            raise InputError(f"has {sure.shape[-1]} channels", where=confidence, expected="one")
        return self.sure(measured, sure, str(confidence))

    def sure(self, measured: DepthImage, confidence: Integer[np.ndarray, "h w"] | None, where: str) -> DepthImage:
        """Return the depth where its confidence, if known, is high, and 0 elsewhere.

        Depth beyond 5 m, the range of the lidar according to Apple, is 0 as well.

        Raises ``InputError``, whose message begins with ``where``, if the confidence image differs in size or has
        values above that of high confidence.
        """
        metres = torch.where(measured.metres <= 5.0, measured.metres, 0)
        if confidence is None:
            return replace(measured, metres=metres)
        if confidence.shape != tuple(metres.shape):
            found = "x".join(map(str, confidence.shape[::-1]))
            raise InputError(f"is {found}", where=where, expected=f"{metres.shape[1]}x{metres.shape[0]} like its depth")
        largest = int(confidence.max())
        high = next((scale for scale in sorted(self._scales) if 0 < largest <= scale), max(self._scales))
        if largest > high:
            raise InputError(f"has values up to {largest}", where=where, expected=f"confidences from 0 to {high}")
        sure = torch.where(torch.from_numpy(confidence == high), metres, 0)
        if not self._remarked and bool(metres.any()) and not bool(sure.any()):
            self._remarked = True
            values = ", ".join(str(value) for value in np.unique(confidence)[:4])
            warn_about(
                where,
                f"has the values {values}, expected {high} where depth is sure; without it, all depth"
                " of this image is left out, and so it is in such images that follow",
            )
        return replace(measured, metres=sure)
