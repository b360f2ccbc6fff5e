"""Recordings of the iOS app Record3D: ``.r3d`` files, or folders with their unpacked content.

A ``.r3d`` file is a zip archive. ``metadata`` is JSON: ``w h`` (of the photos) and ``dw dh`` (of depth),
``K`` (column by column), ``perFrameIntrinsicCoeffs`` (``fx fy cx cy`` of each frame, in newer recordings),
``poses`` (``qx qy qz qw tx ty tz``, camera to world, OpenGL axes), ``frameTimestamps`` (seconds) or ``fps``.
Frame N has ``rgbd/N.jpg``, ``rgbd/N.depth`` (32-bit floats in metres, row by row, compressed with LZFSE) and,
from a lidar, ``rgbd/N.conf`` (one byte of confidence per pixel, compressed too). Reading depth needs the
package ``lzfse``, which the extra ``record3d`` installs. The world frame is the recording's, usually
the camera frame of the first image, so none of its axes is vertical. See ``lidar`` for how depth and photos
are read.

Members of the archive are read one at a time and within limits.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from bidnerf.formats import lidar
from bidnerf_core.datasets import Capture, DatasetOptions, DepthFile, Format, Shot, camera_of, pose_of_numbers
from bidnerf_core.depth import DepthImage, depth_image
from bidnerf_core.errors import InputError
from bidnerf_core.io import Archive, ImageSource, Record, is_file, parse_record, read_file

EXPECTED_RECORDING = "a Record3D recording (.r3d)"


class Recording:
    """The files of a recording, accessed by their names in the archive; the archive may be unpacked to a folder."""

    def __init__(self, path: Path) -> None:
        self.path, self._lidar = path, lidar.LidarDepth()
        self._archive = None if path.is_dir() else Archive(path, EXPECTED_RECORDING)

    def __contains__(self, name: str) -> bool:
        return is_file(self.path / name) if self._archive is None else name in self._archive

    def read(self, name: str) -> bytes:
        return read_file(self.path / name, EXPECTED_RECORDING) if self._archive is None else self._archive.read(name)

    def file(self, name: str) -> ImageSource:
        """Return a file of the recording: an archive member, read when opened, or the path where it is expected in the folder."""
        packed = self._archive is not None and name in self._archive
        return self._archive.file(name) if self._archive is not None and packed else self.path / name

    def depth(self, number: int, size: tuple[int, int]) -> DepthImage:
        """Read the depth of a frame of ``size`` (width, height). Raises ``InputError`` if the number of bytes does not match."""
        depth, confidence = (f"rgbd/{number}.{kind}" for kind in ("depth", "conf"))
        values = self._unpack(depth, "<f4", size)
        metres = np.where(np.isfinite(values) & (values > 0), values, 0)
        sure = self._unpack(confidence, "u1", size).astype(np.int64) if confidence in self else None
        measured = depth_image(metres, 1.0, f"{self.path}/{depth}: depth")
        return self._lidar.sure(measured, sure, f"{self.path}/{confidence}")

    def _unpack(self, name: str, kind: str, size: tuple[int, int]) -> np.ndarray:
        where, packed = f"{self.path}/{name}", self.read(name)
        decompress = _lzfse(self.path)
        try:
            content = decompress(packed)
        except Exception as error:  # a C library raises it
            why = f"not readable as LZFSE ({error})"
            raise InputError(why, where=where, expected="a complete file") from error
        if len(content) != (count := np.dtype(kind).itemsize * math.prod(size)):
            expected = f"{count} according to metadata (dw, dh)"
            raise InputError(f"unpacks to {len(content)} bytes", where=where, expected=expected)
        return np.frombuffer(content, kind).reshape(size[::-1])


def _read(path: Path, metadata_file: Path, options: DatasetOptions) -> Capture:
    """Read the metadata. Raises ``InputError`` if the metadata or the archive is damaged, and if ``lzfse`` is missing."""
    files = Recording(path)
    metadata = parse_record(str(metadata_file), files.read("metadata"), "the metadata of Record3D")
    poses = metadata.items("poses") or []
    if not poses:
        expected = "a list of qx qy qz qw tx ty tz; record with poses switched on"
        raise metadata.error("no poses", expected=expected)
    width, height = metadata.size("w"), metadata.size("h")
    if width is None or height is None:
        raise metadata.error("no w and h", expected="the size of the photos")
    times, cameras = _times(metadata, len(poses)), _cameras(metadata, len(poses))
    if has_depth := any(f"rgbd/{number}.depth" in files for number in range(len(poses))):
        _lzfse(path)  # raises if it is missing
    size, shots = (metadata.size("dw") or width, metadata.size("dh") or height), list[Shot]()
    for number, pose in enumerate(poses):
        where, depth = f"{metadata.where}: pose {number}", f"rgbd/{number}.depth"
        if not isinstance(pose, list) or len(pose) != 7 or not all(type(x) in (int, float) for x in pose):
            raise InputError("is not 7 numbers", where=where, expected="qx qy qz qw tx ty tz")
        file = f"{path / depth}" if depth in files else path / depth
        shots.append(
            Shot(
                image=files.file(f"rgbd/{number}.jpg"),
                camera=camera_of(metadata.where, cameras[number], (width, height)),
                T_world_camera=pose_of_numbers(where, [*pose[4:], *pose[:4]], opengl=True),
                time=times[number],
                depth=DepthFile(file, partial(files.depth, number, size)) if has_depth else None,
                stem=str(number),
                folders=(),
                usual_side=lidar.LARGEST_SIDE,
            )
        )
    return Capture(
        path,
        shots,
        options.colour,
        unit="metres",
        pose_file=metadata.where,
        rate=lidar.FRAMES_PER_SECOND,
        poses_expected="finite qx qy qz qw tx ty tz of each frame",
    )


def _find(path: Path) -> Path | None:
    """Return the location of the metadata in the archive or folder."""
    unpacked = is_file(path / "metadata") and (path / "rgbd").is_dir()
    return path / "metadata" if unpacked or (path.suffix.lower() == ".r3d" and not path.is_dir()) else None


def _lzfse(path: Path) -> Callable[[bytes], bytes]:
    """Return the function that decompresses LZFSE. Raises ``InputError`` if no package provides it."""
    try:
        import lzfse
    except ImportError as error:
        install = "pip install 'bidnerf[record3d]', or pip install lzfse"
        raise InputError(f"reading Record3D depth needs the package lzfse: {install}", where=path) from error
    decompress: Callable[[bytes], bytes] = lzfse.decompress
    return decompress


def _times(metadata: Record, count: int) -> list[float | None]:
    """Return the frame times, from the timestamps or from the frame rate."""
    stamps = metadata.items("frameTimestamps")
    if stamps is not None and len(stamps) >= count:
        return [metadata.checked_number(stamp, "an entry of frameTimestamps") for stamp in stamps[:count]]
    fps = metadata.number("fps")
    return [number / fps if fps else None for number in range(count)]


def _cameras(metadata: Record, count: int) -> list[list[float]]:
    """Return fx, fy, cx and cy of each frame: per-frame values if recorded, else the same values for all."""
    rows, shared = metadata.items("perFrameIntrinsicCoeffs") or [], metadata.items("K") or []
    if len(rows) > count:
        raise metadata.error(f"perFrameIntrinsicCoeffs has {len(rows)} rows", expected=f"{count}, as poses")
    if len(rows) < count:
        rows = [[shared[i] for i in (0, 4, 6, 7)]] * count if len(shared) == 9 else []  # column by column
    if not rows or not all(isinstance(row, list) and len(row) >= 4 for row in rows):
        found = "no K with 9 numbers, and no perFrameIntrinsicCoeffs with 4 for each frame"
        raise metadata.error(found, expected="the intrinsics")
    return [[metadata.checked_number(value, "an intrinsic") for value in row[:4]] for row in rows]


reader = Format(
    "Record3D: depth of confidence 2 up to 5 m (extra 'record3d')",
    "a .r3d file, or metadata with rgbd/0.jpg ... (Record3D)",
    _find,
    _read,
    suffixes=(".r3d",),
    precedence=30,  # a recording with metric poses
)
