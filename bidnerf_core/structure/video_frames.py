"""Selection of video frames for structure from motion: as many as the image motion requires, each the sharpest among
its neighbours.

The image motion is the displacement of tracked corners, accumulated along the video. A shaking camera does
not add to it, since corners are tracked from one anchor frame until they have moved by a few percent of the
image. Frames are chosen at equal steps of the accumulated motion: none while the camera rests, many while it
turns.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from bidnerf_core.camera import reduced_size
from bidnerf_core.captures import sharpness
from bidnerf_core.datasets import Video
from bidnerf_core.progress import counter
from bidnerf_core.structure.sources import SourceImage

STEP = 0.04
"""Image motion between chosen frames, in diagonals."""
ANCHOR = 0.02
"""Image motion, in diagonals, after which corners are redetected."""
MOST = 400
"""Largest number of chosen frames: longer videos use longer steps."""
WINDOW = 0.3
"""Fraction of a step on either side within which the sharpest frame is chosen."""
LEAST_TRACKED = 0.5
"""Fraction of the corners that must still be tracked."""
CORNERS, QUALITY, APART = 200, 0.01, 7
"""Number of corners, their minimum quality relative to the best, and their minimum distance in pixels (Shi
and Tomasi 1994)."""
WIDTH = 320
"""Pixels along the longer side of the images in which corners are tracked."""
JPEG_QUALITY = 95


@dataclass(frozen=True)
class FrameMeasure:
    """The time of a frame (seconds), the accumulated motion until then (diagonals), and its sharpness (octaves)."""

    time: float
    motion: float
    sharpness: float


def measured(video: Path) -> list[FrameMeasure]:
    """Measure each frame of a video."""
    count = counter("measuring frames", "frames")
    frames = Video(video)
    total = len(frames)
    path, found = _Motion(), list[FrameMeasure]()
    for time, pixels in frames:
        grey = cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY)
        found.append(FrameMeasure(time, path.advance(_small(grey)), sharpness(grey.astype(np.float32) / 255)))
        count(min(len(found), total), total)
    return found


def chosen(frames: Sequence[FrameMeasure]) -> list[int]:
    """Return the indices of the frames to place: one for each step of motion, the sharpest near it."""
    motion = np.array([frame.motion for frame in frames])
    sharp = np.array([frame.sharpness for frame in frames])
    step = max(STEP, float(motion[-1]) / (MOST - 1))
    found = set[int]()
    for place in np.arange(round(float(motion[-1]) / step) + 1) * step:
        away = np.abs(motion - place)
        near = np.flatnonzero(away <= WINDOW * step)
        found.add(int(near[sharp[near].argmax()]) if len(near) else int(away.argmin()))
    return sorted(found)


def write_frames(video: Path, folder: Path, wanted: Sequence[int]) -> list[SourceImage]:
    """Write the frames with indices ``wanted`` to ``folder`` as NUMBER.jpg, and return them with their times."""
    folder.mkdir(parents=True, exist_ok=True)
    asked, found, count = set(wanted), list[SourceImage](), counter("writing frames", "frames")
    for number, (time, pixels) in enumerate(Video(video)):
        if number in asked:
            image = SourceImage(f"{number:06d}", folder / f"{number:06d}.jpg", time)
            Image.fromarray(pixels).save(image.file, quality=JPEG_QUALITY, subsampling=0)
            found.append(image)
            count(len(found), len(asked))
        if len(found) == len(asked):
            break
    return found


class _Motion:
    """The accumulated image motion, in diagonals."""

    def __init__(self) -> None:
        self._before: np.ndarray | None = None
        self._points: np.ndarray = np.zeros((0, 1, 2), np.float32)
        self._start = self._points
        self._found = 0
        self._until_anchor = self._total = 0.0

    def advance(self, grey: np.ndarray) -> float:
        """Return the motion up to the next frame."""
        if self._before is None:
            self._anchor(grey)
        elif not len(self._points):  # nothing to track: unknown motion, assumed to be one step
            self._until_anchor = self._total = self._total + STEP
            self._anchor(grey)
        else:
            self._follow(grey)
        self._before = grey
        return self._total

    def _anchor(self, grey: np.ndarray) -> None:
        found = cv2.goodFeaturesToTrack(grey, CORNERS, QUALITY, APART)
        self._points = np.zeros((0, 1, 2), np.float32) if found is None else np.asarray(found)
        self._start = self._points
        self._found = len(self._points)

    def _follow(self, grey: np.ndarray) -> None:
        assert self._before is not None
        moved, kept, _ = cv2.calcOpticalFlowPyrLK(
            self._before, grey, self._points, np.empty_like(self._points)
        )
        ok = kept.reshape(-1) == 1
        self._points, self._start = moved[ok], self._start[ok]
        diagonal = float(np.hypot(*grey.shape))
        if not len(self._points):
            return
        away = float(np.median(np.linalg.norm(self._points - self._start, axis=-1))) / diagonal
        self._total = max(self._total, self._until_anchor + away)
        if away > ANCHOR or len(self._points) < LEAST_TRACKED * self._found:
            self._until_anchor = self._total
            self._anchor(grey)


def _small(grey: np.ndarray) -> np.ndarray:
    size = reduced_size(grey.shape[1], grey.shape[0], WIDTH)
    return grey if size == grey.shape[::-1] else cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
