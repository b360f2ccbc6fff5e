"""Folders exported by the iOS app "3D Scanner App" as "All Data".

A frame N has ``frame_N.json`` (ARKit's ``cameraPoseARFrame``, a row-major camera-to-world matrix with OpenGL axes, and
``intrinsics`` of the photo, 3x3 and row-major). Some frames have a photo ``frame_N.jpg``. Scans with a LiDAR have
``depth_N.png`` (16-bit planar z in millimetres, of lower resolution) with ``conf_N.png`` (ARKit's confidence: 0 low, 1 medium,
2 high). The dataset has the frames with a photo, ordered by number. Every eighth photo (the first, the ninth ...) is held out
as "test" and the others are "train". The sequence also has the frames in between, which have only depth, at the resolution of
the depth; its times are ``time``, in seconds since the phone was switched on.

Photos are large and many: those with more than 640 pixels on the longer side are reduced to that size when they are read,
and the intrinsics with them. A scan of 127 training photos then takes 0.6 GB instead of 1.4 GB. Depth is dropped where the
confidence is not high and beyond 5 m, the range of the LiDAR; each of the photo's pixels has the depth of the nearest
measurement.

ARKit measures pixels from the centre of the upper left one. If a frame has ARKit's ``projectionMatrix``, the
principal point is taken from it: it is relative to the image's borders and so holds for photos of any size.
Otherwise, half a pixel is added.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.camera import Intrinsics, Raster, same_aspect
from bidnerf_core.datasets import (
    Dataset,
    FrameSequence,
    Reader,
    ReadOptions,
    SplitDataset,
    Splits,
    hold_out,
    largest_side,
    pose_of_rows,
    read_rgbd,
)
from bidnerf_core.depth import MILLIMETRE, DepthImage, read_depth_image
from bidnerf_core.errors import InputError
from bidnerf_core.frames import Frame, fit_depth
from bidnerf_core.geometry import SE3, LengthUnit
from bidnerf_core.io import Background, Record, decode, read_file, read_record, reduced

LARGEST_SIDE = 640
"""Default limit of the pixels on a photo's longer side."""
RANGE = 5.0
"""Range of the LiDAR (metres) according to Apple; depth beyond it was inferred from the photo."""
HIGH_CONFIDENCE = 2
POSE, INTRINSICS, PROJECTION = "cameraPoseARFrame", "intrinsics", "projectionMatrix"
PHOTO = re.compile(r"frame_(\d+)\.jpe?g", re.IGNORECASE)
DEPTH = re.compile(r"depth_(\d+)\.png")
OTHER_SIZE = 0.01
"""Relative difference of the focal lengths of ``intrinsics`` and ``projectionMatrix`` that indicates another image size."""


@dataclass(frozen=True, eq=False)
class ScannerFrame:
    """A frame with a photo, with depth, or with both."""

    description: Path
    photo: Path | None
    record: Record
    T_world_camera: SE3
    has_depth: bool

    @property
    def stem(self) -> str:
        return self.description.stem

    @property
    def parts(self) -> tuple[str, ...]:
        return (self.stem,)

    @property
    def time(self) -> float | None:
        return self.record.number("time")

    def beside(self, kind: str) -> Path:
        """Return the frame's file "depth" or "conf"."""
        return self.description.with_name(f"{kind}_{self.stem.split('_')[1]}.png")


@dataclass(frozen=True)
class ScannerAppReader(Reader):
    """Reader for "3D Scanner App" folders; ``largest`` is the default limit of the longer side of photos (pixels)."""

    largest: int = LARGEST_SIDE
    expected = f"frame_0.jpg, frame_0.json ... with {POSE}"

    def recognises(self, path: Path) -> bool:
        """Return whether the first ``frame_N.json`` has an ARKit pose; a malformed one is left to other readers."""
        first = next(iter(sorted(path.glob("frame_*.json"))), None)
        try:
            return first is not None and POSE.encode() in read_file(first, "JSON")
        except InputError:
            return False

    def open(self, path: Path, options: ReadOptions) -> Dataset:
        """Read the metadata of all frames. Raises ``InputError`` if a file is missing or invalid."""
        return self._dataset(path, options)

    def open_sequence(self, path: Path, options: ReadOptions) -> FrameSequence:
        """Read the metadata of all frames, including those that have only depth."""
        return self._dataset(path, options).sequence(depth_frames(path))

    def _dataset(self, path: Path, options: ReadOptions) -> ScannerAppDataset:
        splits = Splits(path, hold_out(scanner_frames(path)))
        return ScannerAppDataset(splits, options.background, self.largest)


class ScannerAppDataset(SplitDataset[ScannerFrame]):
    """Views of a "3D Scanner App" folder; see ``Dataset``."""

    unit: LengthUnit | None = "metres"
    up: tuple[float, float, float] | None = (0.0, 1.0, 0.0)  # ARKit aligns its world with gravity

    def __init__(self, frames: Splits[ScannerFrame], background: Background | None, largest: int) -> None:
        super().__init__(frames, background)
        self._largest = largest

    def _pose(self, frame: ScannerFrame) -> SE3:
        return frame.T_world_camera

    def _frame(self, frame: ScannerFrame, name: str) -> Frame:
        return _between(frame, name) if frame.photo is None else self._with_photo(frame, frame.photo, name)

    def _with_photo(self, frame: ScannerFrame, photo: Path, name: str) -> Frame:
        whole = read_rgbd(name, photo, partial(scanner_camera, frame.record), self._background)
        camera = whole.intrinsics
        limit = largest_side(self._largest) or math.inf
        small = camera.scaled(min(1.0, limit / max(camera.width, camera.height)))
        rgb = whole.rgb if small == camera else reduced(whole.rgb, small.width, small.height)
        depth = None
        if frame.has_depth:
            measured = read_measured(frame.beside("depth"), frame.beside("conf"))
            raster, where = Raster(camera.width, camera.height), f"{frame.beside('depth')}: depth"
            depth = fit_depth(measured, raster, (small.width, small.height), where)
        return Frame(name, rgb, small, depth)


def _between(frame: ScannerFrame, name: str) -> Frame:
    """Read a frame that has only depth. Its metadata file holds the camera of a photo that was not saved."""
    depth = read_measured(frame.beside("depth"), frame.beside("conf")).metres
    height, width = depth.shape
    photo_width, photo_height = projected_size(frame.record)
    if not same_aspect((width, height), (photo_width, photo_height)):
        raise InputError(
            f"depth is {width}x{height}, but its camera's photos are {photo_width}x{photo_height};",
            where=frame.beside("depth"),
            expected="the same aspect ratio",
        )
    camera = scanner_camera(frame.record, photo_width, photo_height).resized(width, height)
    return Frame(name, torch.zeros(height, width, 3), camera, depth, has_colour=False)


def scanner_frames(folder: Path) -> list[ScannerFrame]:
    """Read the metadata of all photos, ordered by number. Raises ``InputError`` if a file is missing or
    invalid.

    Depth is expected for all frames or, from phones without a LiDAR, for none.
    """
    numbered = {path: PHOTO.fullmatch(path.name) for path in folder.iterdir()}
    photos = sorted((int(found[1]), path) for path, found in numbered.items() if found)
    if not photos:
        raise InputError(
            "has frame_N.json but no photo", where=folder, expected="frame_N.jpg next to some of them"
        )
    for (number, path), (following, other) in pairwise(photos):
        if number == following:
            raise InputError(
                f"{path.name} and {other.name} have the same number", where=folder, expected="each once"
            )
    has_depth = any(folder.glob("depth_*.png")) or any(folder.glob("conf_*.png"))
    return [_frame(path.with_suffix(".json"), path, has_depth) for _, path in photos]


def depth_frames(folder: Path) -> list[ScannerFrame]:
    """Read the metadata of the frames that have depth and no photo. Raises ``InputError`` as ``scanner_frames`` does."""
    photos = {path.stem for path in folder.iterdir() if PHOTO.fullmatch(path.name)}
    numbered = {path: DEPTH.fullmatch(path.name) for path in sorted(folder.glob("depth_*.png"))}
    descriptions = [folder / f"frame_{found[1]}.json" for found in numbered.values() if found]
    return [_frame(path, None, True) for path in descriptions if path.stem not in photos]


def _frame(description: Path, photo: Path | None, has_depth: bool) -> ScannerFrame:
    record = read_record(description)
    numbers = _numbers(record, POSE, 16)
    rows = [numbers[first : first + 4] for first in range(0, 16, 4)]
    frame = ScannerFrame(description, photo, record, pose_of_rows(record, POSE, rows), has_depth)
    for kind in ("depth", "conf") if has_depth else ():
        if not frame.beside(kind).is_file():
            there = description if photo is None else photo
            raise InputError(f"no such file, although {there.name} exists", where=frame.beside(kind))
    return frame


def projected_size(record: Record) -> tuple[int, int]:
    """Return the size (width, height) of the photos that the intrinsics describe.

    Raises ``InputError`` if there is no projection matrix to determine it from.
    """
    fx, _, _, _, fy, *_ = _numbers(record, INTRINSICS, 9)
    projection = _numbers(record, PROJECTION, 16)
    if projection[0] <= 0 or projection[5] <= 0:
        raise record.error(f"{PROJECTION} has no positive focal lengths", expected="an ARKit matrix")
    return round(2 * fx / projection[0]), round(2 * fy / projection[5])


def scanner_camera(record: Record, width: int, height: int) -> Intrinsics:
    """Return the camera of a photo of this size. Raises ``InputError`` if the intrinsics are for another size."""
    fx, skew, cx, _, fy, cy, *last = _numbers(record, INTRINSICS, 9)
    if abs(skew) > 1e-6 or last != [0, 0, 1]:
        raise record.error(f"{INTRINSICS} is not [fx, 0, cx, 0, fy, cy, 0, 0, 1]", expected="3x3 row by row")
    centre = (cx + 0.5, cy + 0.5)
    if record.items(PROJECTION) is not None:
        # u = (1 + x_ndc) w / 2 with x_ndc = P00 x / -z - P02, and likewise v, which points down
        projection = _numbers(record, PROJECTION, 16)
        if abs(projection[0] * width / 2 / fx - 1) > OTHER_SIZE:
            raise _other_size(record, width, height)
        centre = (width / 2 * (1 - projection[2]), height / 2 * (1 + projection[6]))
    if not (width / 4 < centre[0] < width * 3 / 4 and height / 4 < centre[1] < height * 3 / 4):
        raise _other_size(record, width, height)
    return Intrinsics(fx, fy, *centre, width, height)


def read_measured(depth: Path, confidence: Path) -> DepthImage:
    """Read depth (metres), 0 where the confidence is not high and outside the sensor's range.

    Raises ``InputError`` if a file cannot be read or does not have the expected content.
    """
    measured = read_depth_image(depth, MILLIMETRE)
    sure = decode(confidence)
    height, width = measured.metres.shape
    if sure.shape != (height, width):
        found = "x".join(map(str, sure.shape[1::-1] + sure.shape[2:]))
        raise InputError(f"is {found}", where=confidence, expected=f"{width}x{height} as {depth.name}")
    if sure.dtype != np.uint8 or sure.max() > HIGH_CONFIDENCE:
        raise InputError(
            f"has values up to {sure.max()}", where=confidence, expected="confidences of 0, 1 and 2"
        )
    return replace(measured, metres=_kept(measured.metres, torch.from_numpy(sure)))


def _kept(metres: Float[Tensor, "h w"], confidence: Tensor) -> Float[Tensor, "h w"]:
    return torch.where((confidence == HIGH_CONFIDENCE) & (metres <= RANGE), metres, 0)


def _other_size(record: Record, width: int, height: int) -> InputError:
    return record.error(
        f"{INTRINSICS} do not match its photo of {width}x{height};",
        expected="intrinsics scaled with the photo",
    )


def _numbers(record: Record, key: str, count: int) -> list[float]:
    """Return ``count`` finite numbers."""
    found = record.items(key)
    if found is None:
        raise record.error(f"no {key}", expected=f"{count} numbers")
    if len(found) != count:
        raise record.error(f"{key} has {len(found)} entries", expected=f"{count} numbers")
    return [record.checked_number(value, f"an entry of {key}") for value in found]


reader = ScannerAppReader()
