"""Recordings of the iOS app Record3D: ``.r3d`` files, or folders with their unpacked content.

A ``.r3d`` file is a zip archive. ``metadata`` is JSON: ``w h`` (of the photos) and ``dw dh`` (of depth),
``K`` (column by column), ``perFrameIntrinsicCoeffs`` (``fx fy cx cy`` of each frame, in newer recordings),
``poses`` (``qx qy qz qw tx ty tz``, camera to world, OpenGL axes), ``frameTimestamps`` (seconds) or ``fps``.
Frame N has ``rgbd/N.jpg``, ``rgbd/N.depth`` (32-bit floats in metres, row by row, compressed with LZFSE) and,
from a lidar, ``rgbd/N.conf`` (a byte of confidence per pixel, compressed likewise). Reading depth needs the
package ``lzfse``, which the extra ``record3d`` installs. The world is that of the recording, usually the
camera frame of its first frame, so none of its axes is vertical. See ``lidar`` for how depth and photos
are read.

Members of the archive are read one at a time and within limits. Every eighth frame of the dataset (the first, the ninth ...) is
held out as "test" and the others are "train".
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from bidnerf_core.datasets import lidar
from bidnerf_core.datasets.capture import Capture, DepthFile, Shot, present, remark
from bidnerf_core.datasets.reader import DatasetOptions, Reader
from bidnerf_core.depth import DepthImage, depth_image
from bidnerf_core.errors import InputError, amount
from bidnerf_core.geometry import SE3
from bidnerf_core.io import Archive, ImageSource, Record, is_file, parse_record, read_file

METADATA = "metadata"
EXPECTED = "a Record3D recording (.r3d)"
FLOAT_BYTES = 4
INSTALL = "pip install 'bidnerf[record3d]', or pip install lzfse"


class _Unpacked:
    """The files of a recording that was unpacked to a folder, by their names in the archive."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def __contains__(self, name: str) -> bool:
        return is_file(self._folder / name)

    def read(self, name: str) -> bytes:
        return read_file(self._folder / name, EXPECTED)

    def file(self, name: str) -> ImageSource:
        return self._folder / name


class Record3DReader(Reader):
    """Reader for Record3D recordings."""

    suffixes = (".r3d",)
    expected = "a .r3d file, or metadata with rgbd/0.jpg ... (Record3D)"

    def recognises(self, path: Path) -> bool:
        if not path.is_dir():
            return path.suffix.lower() == ".r3d"
        return is_file(path / METADATA) and (path / "rgbd").is_dir()

    def read(self, path: Path, options: DatasetOptions) -> Capture:
        """Read the metadata. Raises ``InputError`` if it or the archive is damaged, and if ``lzfse`` is missing."""
        files = _Unpacked(path) if path.is_dir() else Archive(path, EXPECTED)
        metadata = parse_record(f"{path}/{METADATA}", files.read(METADATA), "the metadata of Record3D")
        poses = metadata.items("poses") or []
        if not poses:
            raise metadata.error(
                "no poses", expected="a list of qx qy qz qw tx ty tz; record with poses switched on"
            )
        times, cameras = _times(metadata, len(poses)), _cameras(metadata, len(poses))
        numbers = present(
            range(len(poses)),
            lambda number: f"rgbd/{number}.jpg" in files,
            path,
            lambda number: f"rgbd/{number}.jpg",
            lambda number: InputError(
                "no such photo", where=f"{path}/rgbd/{number}.jpg", expected="one for each pose"
            ),
        )
        measured = [number for number in numbers if f"rgbd/{number}.depth" in files]
        if measured and len(measured) < len(numbers):
            remark(path, f"{len(numbers) - len(measured)} of {amount(len(numbers), 'frame')} have no depth")
        size = metadata.size("dw") or metadata.size("w") or 0, metadata.size("dh") or metadata.size("h") or 0
        read = _Depth(path, files, size) if measured else None
        shots = [
            Shot(
                image=files.file(f"rgbd/{number}.jpg"),
                camera=lidar.arkit_camera(cameras[number], *_size(metadata), metadata.where),
                T_world_camera=_pose(metadata, number, poses[number]),
                time=times[number],
                depth=DepthFile(f"{path}/rgbd/{number}.depth", partial(read, number))
                if read and number in measured
                else None,
                stem=str(number),
                folders=(),
                usual_side=lidar.LARGEST_SIDE,
            )
            for number in numbers
        ]
        return Capture(
            path, lidar.thinned(path, shots), options.colour, unit="metres", pose_file=metadata.where,
            poses_expected="finite qx qy qz qw tx ty tz of each frame",
        )  # fmt: skip


class _Depth:
    """Reads the depth of frames by number."""

    def __init__(self, path: Path, files: _Unpacked | Archive, size: tuple[int, int]) -> None:
        self._path, self._files, self._size, self._lidar = path, files, size, lidar.LidarDepth()
        self._decompress = _lzfse(path)

    def __call__(self, number: int) -> DepthImage:
        depth, sure = (f"rgbd/{number}.{kind}" for kind in ("depth", "conf"))
        (width, height), where = self._size, f"{self._path}/{depth}"
        values = np.frombuffer(self._unpacked(depth, FLOAT_BYTES * width * height), "<f4").reshape(
            height, width
        )
        metres = np.where(np.isfinite(values) & (values > 0), values, 0)
        confidence = None
        if sure in self._files:
            raw = np.frombuffer(self._unpacked(sure, width * height), np.uint8)
            confidence = raw.reshape(height, width).astype(np.int64)
        return self._lidar.sure(
            depth_image(metres, 1.0, f"{where}: depth"), confidence, f"{self._path}/{sure}"
        )

    def _unpacked(self, name: str, size: int) -> bytes:
        """Return the ``size`` decompressed bytes of a file. Raises ``InputError`` for any other number of bytes."""
        where, content = f"{self._path}/{name}", self._files.read(name)
        # Compressed data is never much longer than its content, so longer data would unpack to more than
        # expected.
        if len(content) > size + size // 8 + 1024:
            expected = f"at most the {size} that it should unpack to"
            raise InputError(f"has {len(content)} bytes", where=where, expected=expected)
        try:
            found = self._decompress(content)
        except Exception as error:  # raised by a C library
            raise InputError(
                f"not readable as LZFSE ({error})", where=where, expected="a complete file"
            ) from error
        if len(found) != size:
            expected = f"{size} according to metadata (dw, dh)"
            raise InputError(f"unpacks to {len(found)} bytes", where=where, expected=expected)
        return found


def _lzfse(path: Path) -> Callable[[bytes], bytes]:
    """Return the function that decompresses LZFSE. Raises ``InputError`` if no package provides it."""
    try:
        import lzfse
    except ImportError:
        try:
            import liblzfse as lzfse  # the same code under its former name
        except ImportError as error:
            raise InputError(
                f"reading Record3D depth needs the package lzfse: {INSTALL}", where=path
            ) from error
    decompress: Callable[[bytes], bytes] = lzfse.decompress
    return decompress


def _pose(metadata: Record, number: int, numbers: Any) -> SE3 | None:
    where = f"{metadata.where}: pose {number}"
    if not isinstance(numbers, list) or len(numbers) != 7 or not all(_is_number(value) for value in numbers):
        raise InputError("is not 7 numbers", where=where, expected="qx qy qz qw tx ty tz")
    return lidar.pose_of_numbers(where, numbers, opengl=True)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _times(metadata: Record, count: int) -> list[float | None]:
    """Return the frame times, from their stamps or from the rate."""
    stamps = metadata.items("frameTimestamps")
    if stamps is not None and len(stamps) >= count:
        return [metadata.checked_number(stamp, "an entry of frameTimestamps") for stamp in stamps[:count]]
    fps = metadata.number("fps")
    return [number / fps if fps else None for number in range(count)]


def _size(metadata: Record) -> tuple[int, int]:
    width, height = metadata.size("w"), metadata.size("h")
    if width is None or height is None:
        raise metadata.error("no w and h", expected="the size of the photos")
    return width, height


def _cameras(metadata: Record, count: int) -> list[list[float]]:
    """Return fx, fy, cx and cy of the frames: their own, or the first frame's for all."""
    own, shared = metadata.items("perFrameIntrinsicCoeffs"), metadata.items("K")
    if own is not None and len(own) >= count:
        rows = [row if isinstance(row, list) else [] for row in own[:count]]
    elif shared is not None and len(shared) == 9:
        rows = [[shared[0], shared[4], shared[6], shared[7]]] * count  # column by column
    else:
        raise metadata.error("no K with 9 numbers", expected="the intrinsics")
    short = next((row for row in rows if len(row) < 4), None)
    if short is not None:
        raise metadata.error(f"perFrameIntrinsicCoeffs has {short}", expected="fx fy cx cy")
    return [
        [metadata.checked_number(value, "an entry of the intrinsics") for value in row[:4]] for row in rows
    ]


reader = Record3DReader()
