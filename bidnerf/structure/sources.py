"""The input of structure from motion: photos of a folder and its subfolders, and frames of a video.

As many frames are chosen as the image motion requires, each the sharpest among its neighbours. The image motion is the displacement
of tracked corners, accumulated along the video. Camera shake does not add to the motion, since corners are tracked from one anchor
frame until they have moved by a few percent of the image. Frames are chosen at equal steps of the accumulated motion: none while the
camera rests, many while it turns.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeAlias

import cv2
import numpy as np
from PIL import Image

from bidnerf_core.camera import Camera, CameraSource, reduced_size
from bidnerf_core.datasets import (
    VIDEO_SUFFIXES,
    Capture,
    DatasetOptions,
    Shot,
    Video,
    VideoPicture,
    find_reader,
    is_video,
    no_dataset,
    photos_below,
    unposed_recording,
    warn_about,
)
from bidnerf_core.errors import InputError
from bidnerf_core.io import looks_like_image, open_binary, read_header, read_image, require_existing
from bidnerf_core.progress import counter
from bidnerf_core.training import sharpness

FRAME_STEP = 0.04
"""Image motion between chosen frames, as a fraction of the image diagonal."""
FEW_PHOTOS = 60
"""Largest number of images of a recording that are all used; of more, frames are chosen as of a video."""
MOST = 400
"""Largest number of chosen frames; in long videos, the steps are longer."""

Measure: TypeAlias = tuple[float, float]
"""The motion accumulated up to a frame (in image diagonals), and the sharpness of the frame (octaves)."""


def photos_of(
    source: Path, out: Path | None = None, camera: Camera | CameraSource | str | Path | None = None
) -> Capture:
    """Return the photos of a folder in natural name order, or the frames of a video or a recording without poses in order of time.

    If a folder itself has no photos, those of its subfolders are used, except for depth, masks and the like, and ``out``. Only
    the pixels of the frames of a video are meaningful, not their cameras. Raises ``InputError`` if there is no such folder, if
    there are no photos, and if poses are known.
    """
    require_existing(source, expected="photos or a video")
    if is_video(source):
        video = Video(source)
        pictures = [VideoPicture(video, number, is_upright=True) for number in range(len(video))]
        times = zip(pictures, video.times, strict=True)
        return Capture(
            source, [Shot(image=i, camera=CameraSource(hfov=60), time=t, stem=f"{i.number}") for i, t in times]
        )
    reader = find_reader(source)
    if not source.is_dir() and reader is None:
        raise InputError(
            "is a single photo" if looks_like_image(source) else "is a file",
            where=source,
            expected=f"a folder of photos from several places, or a video ({', '.join(VIDEO_SUFFIXES)})",
        )
    if reader is None:
        files = photos_below(source, out)
        if not files:
            raise no_dataset(source)
        return Capture(source, [Shot(image=f, folders=f.relative_to(source).parts[:-1]) for f in files])
    recording = unposed_recording(source, DatasetOptions(camera))
    if recording is None:
        raise InputError(
            f"is a dataset whose poses are known ({reader.expected}); train with it directly, or give only"
            " the folder of the photos to find their poses again",
            where=source,
        )
    warn_about(source, f"its {recording.pose_file or 'recording'} has no poses, so they are found from its images")
    if len(recording) <= FEW_PHOTOS or recording.shots[0].file is None:
        return recording
    return replace(recording, shots=[recording.shots[number] for number in choose_frames(measure_frames(recording))])


def refuse_panoramas(files: Sequence[Path]) -> None:
    """Raise ``InputError`` for panoramas, since no pinhole camera describes them.

    A photo is one according to its XMP, and most photos that are twice as wide as high and whose left edge continues the
    right one are.
    """
    joined, expected = (
        list[bool](),
        "poses with camera_model EQUIRECTANGULAR in transforms.json, or pinhole views cut from it",
    )
    for path in files:
        head = b""
        with contextlib.suppress(InputError), open_binary(path, "a photo") as file:  # left out later
            head = file.read(2**18)  # contains the XMP: a segment has at most 64 KiB, and EXIF precedes it
            joined += [_edges_continue(path)] if len(joined) < 20 else []
        if b"equirectangular" in head:
            raise InputError("is a panorama (equirectangular)", where=path, expected=expected)
    if sum(joined) > len(joined) / 2:
        raise InputError(
            "is twice as wide as high and its edges continue each other, as in a panorama (equirectangular)",
            where=files[0].parent,
            expected=expected,
        )


def _edges_continue(photo: Path) -> bool:
    """Return whether a photo is twice as wide as high and its edges differ hardly more than neighbouring columns do."""
    width, height = read_header(photo).size
    if abs(width - 2 * height) > 1:
        return False
    rgb, _ = read_image(photo, size=reduced_size(width, height, 512))
    steps = (rgb - rgb.roll(1, 1)).abs().mean((0, 2))  # the first is that from the right edge to the left one
    return bool(steps[0] < 3 * steps[1:].median())


def measure_frames(frames: Capture) -> list[Measure]:
    """Measure the image motion and sharpness of each frame of a video or another recording.

    Up to 200 corners (Shi and Tomasi 1994) are tracked in images of at most 320 pixels a side, from an anchor frame until they have
    moved by two percent of the diagonal or half of them are lost.
    """
    count = counter("measuring frames", "frames")
    measures, total = list[Measure](), len(frames)
    before: np.ndarray | None = None
    points = start = np.zeros((0, 1, 2), np.float32)
    corners, until_anchor, motion = 0, 0.0, 0.0
    for timed in frames:
        whole = cv2.cvtColor(timed.frame.rgb_bytes.numpy(), cv2.COLOR_RGB2GRAY)
        size = reduced_size(whole.shape[1], whole.shape[0], 320)
        grey = whole if size == whole.shape[::-1] else cv2.resize(whole, size, interpolation=cv2.INTER_AREA)
        is_anchor = not len(points)
        if before is not None and is_anchor:  # nothing to track: unknown motion, assumed to be one step
            motion += FRAME_STEP
        elif before is not None:
            moved, status, _ = cv2.calcOpticalFlowPyrLK(before, grey, points, np.empty_like(points))
            ok = status.reshape(-1) == 1
            points, start = moved[ok], start[ok]
            if len(points):
                away = float(np.median(np.linalg.norm(points - start, axis=-1))) / float(np.hypot(*grey.shape))
                motion = max(motion, until_anchor + away)
                is_anchor = away > 0.02 or len(points) < 0.5 * corners
        if is_anchor:
            until_anchor = motion
            detected = cv2.goodFeaturesToTrack(grey, 200, 0.01, 7)  # corners, quality, and distance in pixels
            points = start = np.zeros((0, 1, 2), np.float32) if detected is None else np.asarray(detected)
            corners = len(points)
        before = grey
        measures.append((motion, sharpness(whole.astype(np.float32) / 255)))
        count(min(len(measures), total), total)
    return measures


def choose_frames(frames: Sequence[Measure]) -> list[int]:
    """Return the indices of the frames whose poses are searched: at each step of motion, the sharpest one near it."""
    motion, sharp = np.array(frames).T
    step = max(FRAME_STEP, float(motion[-1]) / (MOST - 1))
    chosen = set[int]()
    for target in np.arange(round(float(motion[-1]) / step) + 1) * step:
        away = np.abs(motion - target)
        near = np.flatnonzero(away <= 0.3 * step)
        chosen.add(int(near[sharp[near].argmax()]) if len(near) else int(away.argmin()))
    return sorted(chosen)


def write_frames(frames: Capture, folder: Path, wanted: Sequence[int]) -> Capture:
    """Write the frames with indices ``wanted``, in order, to ``folder`` as NUMBER.jpg, and return these photos with their times."""
    folder.mkdir(parents=True, exist_ok=True)
    written, count = list[Shot](), counter("writing frames", "frames")
    for number in wanted:
        file, timed = folder / f"{number:06d}.jpg", frames[number]
        Image.fromarray(timed.frame.rgb_bytes.numpy()).save(file, quality=95, subsampling=0)
        written.append(Shot(image=file, folders=(), time=timed.time))
        count(len(written), len(wanted))
    return Capture(folder, written)
