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

import re
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path

import torch

from bidnerf.formats import LidarDepth
from bidnerf_core.camera import Intrinsics, same_aspect
from bidnerf_core.datasets import Capture, DatasetOptions, DepthFile, Reader, Shot, hold_out, pose_of_rows
from bidnerf_core.errors import InputError
from bidnerf_core.frames import Frame
from bidnerf_core.io import Record, read_file, read_header, read_record

LARGEST_SIDE = 640
"""Default limit of the pixels on a photo's longer side."""
POSE, INTRINSICS, PROJECTION = "cameraPoseARFrame", "intrinsics", "projectionMatrix"
PHOTO = re.compile(r"frame_(\d+)\.jpe?g", re.IGNORECASE)
DEPTH = re.compile(r"depth_(\d+)\.png")


@dataclass(frozen=True, eq=False, kw_only=True)
class DepthShot(Shot):
    """A frame that has only depth. Its metadata file holds the camera of a photo that was not saved."""

    record: Record
    depth: DepthFile

    def frame(self, background: tuple[float, float, float] = (0.0, 0.0, 0.0), side: int | None = None) -> Frame:
        """Read the depth, at its own resolution."""
        metres = self.depth.read().metres
        height, width = metres.shape
        photo_width, photo_height = projected_size(self.record)
        if not same_aspect((width, height), (photo_width, photo_height)):
            raise InputError(
                f"depth is {width}x{height}, but its camera's photos are {photo_width}x{photo_height};",
                where=self.depth.path,
                expected="the same aspect ratio",
            )
        camera = scanner_camera(self.record, photo_width, photo_height).resized(width, height)
        return Frame(self.name, torch.zeros(height, width, 3), camera, metres, has_colour=False)


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

    def read(self, path: Path, options: DatasetOptions) -> Capture:
        """Read the metadata of all frames; those with only depth are in no split.

        Raises ``InputError`` if a file is missing or invalid. Depth is expected for all frames or, from phones
        without a LiDAR, for none.
        """
        numbered = {file: PHOTO.fullmatch(file.name) for file in path.iterdir()}
        photos = sorted((int(found[1]), file) for file, found in numbered.items() if found)
        if not photos:
            expected = "frame_N.jpg next to some of them"
            raise InputError("has frame_N.json but no photo", where=path, expected=expected)
        for (number, file), (following, other) in pairwise(photos):
            if number == following:
                found = f"{file.name} and {other.name} have the same number"
                raise InputError(found, where=path, expected="each once")
        measured = {file: DEPTH.fullmatch(file.name) for file in sorted(path.glob("depth_*.png"))}
        between = {path / f"frame_{found[1]}.json": None for found in measured.values() if found}
        read = LidarDepth() if measured or any(path.glob("conf_*.png")) else None
        described = {file.with_suffix(".json"): file for _, file in photos}
        shots = [self._shot(file, photo, read) for file, photo in {**between, **described}.items()]
        shots.sort(key=lambda shot: int(shot.stem.split("_")[1]))
        up = (0.0, 1.0, 0.0)  # ARKit aligns its world with gravity
        return Capture(path, hold_out(shots, lambda shot: shot.image is not None), options.colour, unit="metres", up=up)

    def _shot(self, description: Path, photo: Path | None, read: LidarDepth | None) -> Shot:
        record = read_record(description)
        numbers = _numbers(record, POSE, 16)
        rows = [numbers[first : first + 4] for first in range(0, 16, 4)]
        about = {
            "T_world_camera": pose_of_rows(record, POSE, rows),
            "time": record.number("time"),
            "stem": description.stem,
            "folders": (),
        }
        measured = None
        if read is not None:
            number = description.stem.split("_")[1]
            depth, confidence = (description.with_name(f"{kind}_{number}.png") for kind in ("depth", "conf"))
            for file in (depth, confidence):
                if not file.is_file():
                    there = description if photo is None else photo
                    raise InputError(f"no such file, although {there.name} exists", where=file)
            measured = DepthFile(depth, partial(read, depth, confidence))
        if photo is None:
            assert measured is not None  # which is why it is listed
            return DepthShot(record=record, depth=measured, **about)  # type: ignore[arg-type]
        header = read_header(photo)
        camera = scanner_camera(record, header.width, header.height)
        return Shot(image=photo, camera=camera, depth=measured, usual_side=self.largest, **about)  # type: ignore[arg-type]


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
        # Unless the focal lengths of ``intrinsics`` and ``projectionMatrix`` agree, they are for different sizes.
        if abs(projection[0] * width / 2 / fx - 1) > 0.01:
            raise _other_size(record, width, height)
        centre = (width / 2 * (1 - projection[2]), height / 2 * (1 + projection[6]))
    if not (width / 4 < centre[0] < width * 3 / 4 and height / 4 < centre[1] < height * 3 / 4):
        raise _other_size(record, width, height)
    return Intrinsics(fx, fy, *centre, width, height)


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
