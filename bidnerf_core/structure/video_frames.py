"""Selection of video frames for structure from motion: as many as the image motion requires, and sharp ones.

Each is the sharpest among its neighbours. The image motion is the displacement of tracked corners, accumulated
along the video. A shaking camera does not add to it, since corners are tracked from one anchor frame until they
have moved by a few percent of the image. Frames are chosen at equal steps of the accumulated motion: none while
the camera rests, many while it turns.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TypeAlias

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
MOST = 400
"""Largest number of chosen frames: longer videos use longer steps."""

Measure: TypeAlias = tuple[float, float]
"""The accumulated motion (diagonals) until a frame, and its sharpness (octaves)."""


def measured(video: Path) -> list[Measure]:
    """Measure each frame of a video.

    Up to 200 corners (Shi and Tomasi 1994) are tracked in images of at most 320 pixels a side, from an anchor frame until they have
    moved by two percent of the diagonal or half of them are lost.
    """
    count = counter("measuring frames", "frames")
    frames, found = Video(video), list[Measure]()
    total = len(frames)
    before: np.ndarray | None = None
    points = start = np.zeros((0, 1, 2), np.float32)
    corners, until_anchor, motion = 0, 0.0, 0.0
    for _, pixels in frames:
        whole = cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY)
        size = reduced_size(whole.shape[1], whole.shape[0], 320)
        grey = whole if size == whole.shape[::-1] else cv2.resize(whole, size, interpolation=cv2.INTER_AREA)
        is_anchor = not len(points)
        if before is not None and is_anchor:  # nothing to track: unknown motion, assumed to be one step
            motion += STEP
        elif before is not None:
            moved, kept, _ = cv2.calcOpticalFlowPyrLK(before, grey, points, np.empty_like(points))
            ok = kept.reshape(-1) == 1
            points, start = moved[ok], start[ok]
            if len(points):
                away = float(np.median(np.linalg.norm(points - start, axis=-1))) / float(
                    np.hypot(*grey.shape)
                )
                motion = max(motion, until_anchor + away)
                is_anchor = away > 0.02 or len(points) < 0.5 * corners
        if is_anchor:
            until_anchor = motion
            detected = cv2.goodFeaturesToTrack(grey, 200, 0.01, 7)  # corners, quality, and distance in pixels
            points = start = np.zeros((0, 1, 2), np.float32) if detected is None else np.asarray(detected)
            corners = len(points)
        before = grey
        found.append((motion, sharpness(whole.astype(np.float32) / 255)))
        count(min(len(found), total), total)
    return found


def chosen(frames: Sequence[Measure]) -> list[int]:
    """Return the indices of the frames to place: one for each step of motion, the sharpest near it."""
    motion, sharp = np.array(frames).T
    step = max(STEP, float(motion[-1]) / (MOST - 1))
    found = set[int]()
    for place in np.arange(round(float(motion[-1]) / step) + 1) * step:
        away = np.abs(motion - place)
        near = np.flatnonzero(away <= 0.3 * step)
        found.add(int(near[sharp[near].argmax()]) if len(near) else int(away.argmin()))
    return sorted(found)


def write_frames(video: Path, folder: Path, wanted: Sequence[int]) -> list[SourceImage]:
    """Write the frames with indices ``wanted`` to ``folder`` as NUMBER.jpg, and return them with their times."""
    folder.mkdir(parents=True, exist_ok=True)
    asked, found, count = set(wanted), list[SourceImage](), counter("writing frames", "frames")
    for number, (time, pixels) in enumerate(Video(video)):
        if number in asked:
            image = SourceImage(f"{number:06d}", folder / f"{number:06d}.jpg", time)
            Image.fromarray(pixels).save(image.file, quality=95, subsampling=0)
            found.append(image)
            count(len(found), len(asked))
        if len(found) == len(asked):
            break
    return found
