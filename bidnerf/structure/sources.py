"""The input of structure from motion: photos of a folder and its subfolders, and frames of a video.

As many frames are chosen as the image motion requires, each the sharpest among its neighbours. The image motion is the displacement
of tracked corners, accumulated along the video. Camera shake does not add to the motion, since corners are tracked from one anchor
frame until they have moved by a few percent of the image. Frames are chosen at equal steps of the accumulated motion: none while the
camera rests, many while it turns.
"""

from __future__ import annotations

import contextlib
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, TypeAlias

import cv2
import numpy as np
from PIL import Image

from bidnerf_core.camera import Camera, CameraSource, reduced_size
from bidnerf_core.datasets import (
    VIDEO_SUFFIXES,
    Capture,
    DatasetOptions,
    DepthFile,
    Video,
    find_reader,
    is_video,
    no_dataset,
    photos_below,
    unique_names,
    unposed_recording,
    warn_about,
)
from bidnerf_core.errors import InputError
from bidnerf_core.io import open_binary, read_header, read_image
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


class Frames(Protocol):
    """The frames of a recording in chronological order: their times (seconds) and upright pixels."""

    def __len__(self) -> int: ...

    def __iter__(self) -> Iterator[tuple[float | None, np.ndarray]]: ...


@dataclass(frozen=True)
class CaptureFrames:
    """The frames of a capture."""

    capture: Capture

    def __len__(self) -> int:
        return len(self.capture)

    def __iter__(self) -> Iterator[tuple[float | None, np.ndarray]]:
        return ((timed.time, timed.frame.rgb_bytes.numpy()) for timed in self.capture)


@dataclass(frozen=True)
class SourceImage:
    """A photo, or a frame of a video that was written as an image."""

    name: str  # unique among the images: the stem, prefixed with as many folders as needed
    file: Path
    time: float | None = None  # seconds, of a frame of a video
    camera: CameraSource = CameraSource()  # as a recording states it
    depth: DepthFile | None = None
    depth_unit: float | None = None  # metres per step of the depth image, if it is an image of steps


def recorded_frames(source: Path, camera: Camera | CameraSource | str | Path | None) -> Frames | None:
    """Return the frames that have to be written as images: those of a video, or of a recording that is a single file."""
    if is_video(source):
        return Video(source)
    recording = unposed_recording(source, DatasetOptions(camera))
    return CaptureFrames(recording) if recording is not None and recording.shots[0].file is None else None


def photos_of(
    folder: Path, out: Path | None = None, camera: Camera | CameraSource | str | Path | None = None
) -> list[SourceImage]:
    """Return the photos of a folder in natural name order, or of a recording without poses in chronological order.

    If the folder itself has none, those of its subfolders are used, except for depth, masks and the like, and ``out``. Raises
    ``InputError`` if there is no such folder, if there are no photos, and if poses are known.
    """
    if not folder.exists():
        raise InputError("no such file or folder", where=folder, expected="photos or a video")
    reader = find_reader(folder)
    if not folder.is_dir() and reader is None:
        raise InputError(
            "is a file", where=folder, expected=f"a folder of photos or a video ({', '.join(VIDEO_SUFFIXES)})"
        )
    if reader is not None:
        options = DatasetOptions(camera)
        recording = unposed_recording(folder, options)
        if recording is None:
            raise InputError(
                f"is a dataset whose poses are known ({reader.expected}); train with it directly, or give only"
                " the folder of the photos to find their poses again",
                where=folder,
            )
        warn_about(folder, f"its {recording.pose_file or 'recording'} has no poses, so they are found from its images")
        chosen: Sequence[int] = range(len(recording))
        if len(chosen) > FEW_PHOTOS:
            chosen = choose_frames(measure_frames(CaptureFrames(recording)))
        return [
            SourceImage(
                shot.name,
                shot.file,
                shot.time,
                shot.camera if isinstance(shot.camera, CameraSource) else CameraSource(shot.camera),
                shot.depth,
                recording.depth_unit,
            )
            for shot in (recording.shots[number] for number in chosen)
            if shot.file is not None
        ]
    files = photos_below(folder, out)
    if not files:
        raise no_dataset(folder)
    names = unique_names([(*file.relative_to(folder).parts[:-1], file.stem) for file in files])
    return [SourceImage(name, file) for name, file in zip(names, files, strict=True)]


def refuse_panoramas(photos: Sequence[SourceImage]) -> None:
    """Raise ``InputError`` for panoramas, since no pinhole camera describes them.

    A photo is one according to its XMP, and most photos that are twice as wide as high and whose left edge continues the
    right one are.
    """
    joined, expected = (
        list[bool](),
        "poses with camera_model EQUIRECTANGULAR in transforms.json, or pinhole views cut from it",
    )
    for photo in photos:
        head = b""
        with contextlib.suppress(InputError), open_binary(photo.file, "a photo") as file:  # left out later
            head = file.read(2**18)  # contains the XMP: a segment has at most 64 KiB, and EXIF precedes it
            joined += [_edges_continue(photo.file)] if len(joined) < 20 else []
        if b"equirectangular" in head:
            raise InputError("is a panorama (equirectangular)", where=photo.file, expected=expected)
    if sum(joined) > len(joined) / 2:
        found = "is twice as wide as high and its edges continue each other, as in a panorama (equirectangular)"
        raise InputError(found, where=photos[0].file.parent, expected=expected)


def _edges_continue(photo: Path) -> bool:
    """Return whether a photo is twice as wide as high and its edges differ hardly more than neighbouring columns do."""
    header = read_header(photo)
    if abs(header.width - 2 * header.height) > 1:
        return False
    rgb, _ = read_image(photo, size=reduced_size(header.width, header.height, 512))
    steps = (rgb - rgb.roll(1, 1)).abs().mean((0, 2))  # the first is that from the right edge to the left one
    return bool(steps[0] < 3 * steps[1:].median())


def measure_frames(frames: Frames) -> list[Measure]:
    """Measure the image motion and sharpness of each frame of a video or another recording.

    Up to 200 corners (Shi and Tomasi 1994) are tracked in images of at most 320 pixels a side, from an anchor frame until they have
    moved by two percent of the diagonal or half of them are lost.
    """
    count = counter("measuring frames", "frames")
    measures, total = list[Measure](), len(frames)
    before: np.ndarray | None = None
    points = start = np.zeros((0, 1, 2), np.float32)
    corners, until_anchor, motion = 0, 0.0, 0.0
    for _, pixels in frames:
        whole = cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY)
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


def write_frames(frames: Frames, folder: Path, wanted: Collection[int]) -> list[SourceImage]:
    """Write the frames with indices ``wanted`` to ``folder`` as NUMBER.jpg, and return them with their times."""
    folder.mkdir(parents=True, exist_ok=True)
    written, count = list[SourceImage](), counter("writing frames", "frames")
    for number, (time, pixels) in enumerate(frames):
        if number in wanted:
            image = SourceImage(f"{number:06d}", folder / f"{number:06d}.jpg", time)
            Image.fromarray(pixels).save(image.file, quality=95, subsampling=0)
            written.append(image)
            count(len(written), len(wanted))
        if len(written) == len(wanted):
            break
    return written
