"""Recordings of the iOS app Record3D: ``.r3d`` files, or folders with their unpacked content.

A ``.r3d`` file is a zip archive. ``metadata`` is JSON: ``w h`` (of the photos) and ``dw dh`` (of depth),
``K`` (column by column), ``perFrameIntrinsicCoeffs`` (``fx fy cx cy`` of each frame, in newer recordings),
``poses`` (``qx qy qz qw tx ty tz``, camera to world, OpenGL axes), ``frameTimestamps`` (seconds) or ``fps``.
Frame N has ``rgbd/N.jpg``, ``rgbd/N.depth`` (32-bit floats in metres, row by row, compressed with LZFSE) and,
from a lidar, ``rgbd/N.conf`` (a byte of confidence per pixel, compressed likewise). Reading depth needs the
package ``lzfse``, which the extra ``record3d`` installs. The world is that of the recording, usually the
camera frame of its first frame, so none of its axes is vertical. See ``phone_scans`` for how depth and photos
are read.

Members of the archive are read one at a time and within limits. Every eighth frame of the dataset (the first, the ninth ...) is
held out as "test" and the others are "train".
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from bidnerf_core.camera import Intrinsics
from bidnerf_core.datasets.dataset import Dataset
from bidnerf_core.datasets.incomplete import present, remark
from bidnerf_core.datasets.phone_scans import (
    CENTRE_OF_PIXEL,
    Measured,
    SureDepth,
    pose_of_numbers,
    scan_frame,
    thinned,
)
from bidnerf_core.datasets.reader import Reader, ReadOptions
from bidnerf_core.datasets.sequence import FrameSequence
from bidnerf_core.datasets.splits import SplitDataset, Splits, hold_out
from bidnerf_core.depth import depth_image
from bidnerf_core.errors import InputError, amount
from bidnerf_core.frames import Frame
from bidnerf_core.geometry import SE3, LengthUnit
from bidnerf_core.io import (
    Archive,
    Background,
    ImageSource,
    Record,
    is_file,
    parse_record,
    read_compact_image,
    read_file,
)

METADATA = "metadata"
EXPECTED = "a Record3D recording (.r3d)"
FLOAT_BYTES = 4
INSTALL = "pip install 'bidnerf[record3d]', or pip install lzfse"


class _Files(Protocol):
    """The files of a recording, by their names in the archive."""

    def __contains__(self, name: str) -> bool: ...
    def read(self, name: str) -> bytes: ...
    def file(self, name: str) -> ImageSource: ...


class _Unpacked:
    """The files of a recording that was unpacked to a folder."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def __contains__(self, name: str) -> bool:
        return is_file(self._folder / name)

    def read(self, name: str) -> bytes:
        return read_file(self._folder / name, EXPECTED)

    def file(self, name: str) -> Path:
        return self._folder / name


@dataclass(frozen=True, eq=False)
class Record3DFrame:
    """A frame of a recording."""

    number: int
    time: float | None
    camera: Intrinsics  # of the photo
    T_world_camera: SE3 | None

    @property
    def stem(self) -> str:
        return str(self.number)

    @property
    def parts(self) -> tuple[str, ...]:
        return (self.stem,)

    def file(self, kind: str) -> str:
        """Return the name of the frame's "jpg", "depth" or "conf" file."""
        return f"rgbd/{self.number}.{kind}"


class Record3DReader(Reader):
    """Reader for Record3D recordings."""

    suffixes = (".r3d",)
    expected = "a .r3d file, or metadata with rgbd/0.jpg ... (Record3D)"

    def recognises(self, path: Path) -> bool:
        return path.suffix.lower() == ".r3d" if not path.is_dir() else _is_unpacked(path)

    def open(self, path: Path, options: ReadOptions) -> Dataset:
        """Read the metadata. Raises ``InputError`` if it or the archive is damaged, and if ``lzfse`` is missing."""
        return self._open(path, options)[0]

    def open_sequence(self, path: Path, options: ReadOptions) -> FrameSequence:
        dataset, others = self._open(path, options)
        return dataset.sequence(others)

    def _open(self, path: Path, options: ReadOptions) -> tuple[Record3DDataset, list[Record3DFrame]]:
        files: _Files = _Unpacked(path) if path.is_dir() else Archive(path, EXPECTED)
        metadata = parse_record(f"{path}/{METADATA}", files.read(METADATA), "the metadata of Record3D")
        frames = _frames(path, metadata, files)
        kept, others = thinned(path, frames)
        return Record3DDataset(Splits(path, hold_out(kept)), files, metadata, options.background), others


class Record3DDataset(SplitDataset[Record3DFrame]):
    """Views of a recording; see ``Dataset``."""

    unit: LengthUnit | None = "metres"

    def __init__(
        self, frames: Splits[Record3DFrame], files: _Files, metadata: Record, background: Background | None
    ) -> None:
        super().__init__(frames, background)
        self._files, self._sure = files, SureDepth()
        self._size = metadata.size("dw"), metadata.size("dh")
        self._decompress: Callable[[bytes], bytes] | None = None
        if any(frame.file("depth") in files for _, frame in frames.distinct()):
            self._decompress = _lzfse(frames.path)

    def _pose(self, frame: Record3DFrame) -> SE3 | None:
        return frame.T_world_camera

    def _frame(self, frame: Record3DFrame, name: str) -> Frame:
        image = self._files.file(frame.file("jpg"))
        rgb, _ = read_compact_image(image, self._background)
        return scan_frame(name, rgb, frame.camera, self._depth(frame), str(image))

    def _depth(self, frame: Record3DFrame) -> Measured | None:
        if frame.file("depth") not in self._files:
            return None
        where = f"{self.path}/{frame.file('depth')}"
        width, height = self._size
        width, height = width or frame.camera.width, height or frame.camera.height
        raw = self._unpacked(frame.file("depth"), FLOAT_BYTES * width * height)
        values = np.frombuffer(raw, "<f4").reshape(height, width)
        measured = depth_image(
            np.where(np.isfinite(values) & (values > 0), values, 0), 1.0, f"{where}: depth"
        )
        confidence = None
        if frame.file("conf") in self._files:
            sure = self._unpacked(frame.file("conf"), width * height)
            confidence = np.frombuffer(sure, np.uint8).reshape(height, width)
        return Measured(self._sure(measured, confidence, f"{self.path}/{frame.file('conf')}"), where)

    def _unpacked(self, name: str, size: int) -> bytes:
        """Return the ``size`` decompressed bytes of a file. Raises ``InputError`` for any other number of bytes."""
        where, content = f"{self.path}/{name}", self._files.read(name)
        assert self._decompress is not None  # there is depth
        # Compressed data is never much longer than its content, so longer data would unpack to more than
        # expected.
        if len(content) > size + size // 8 + 1024:
            raise InputError(
                f"has {len(content)} bytes",
                where=where,
                expected=f"at most the {size} that it should unpack to",
            )
        try:
            found = self._decompress(content)
        except Exception as error:  # raised by a C library
            raise InputError(
                f"not readable as LZFSE ({error})", where=where, expected="a complete file"
            ) from error
        if len(found) != size:
            raise InputError(
                f"unpacks to {len(found)} bytes",
                where=where,
                expected=f"{size} according to metadata (dw, dh)",
            )
        return found


def _is_unpacked(folder: Path) -> bool:
    return is_file(folder / METADATA) and (folder / "rgbd").is_dir()


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


def _frames(path: Path, metadata: Record, files: _Files) -> list[Record3DFrame]:
    """Return the frames with a photo and a pose; remarks count the others."""
    poses = metadata.items("poses") or []
    if not poses:
        raise metadata.error(
            "no poses", expected="a list of qx qy qz qw tx ty tz; record with poses switched on"
        )
    times, cameras = _times(metadata, len(poses)), _cameras(metadata, len(poses))
    frames = [
        Record3DFrame(number, times[number], cameras[number], _pose(metadata, number, numbers))
        for number, numbers in enumerate(poses)
    ]
    there = present(
        frames,
        lambda frame: frame.file("jpg") in files,
        path,
        lambda frame: frame.file("jpg"),
        lambda frame: InputError(
            "no such photo", where=f"{path}/{frame.file('jpg')}", expected="one for each pose"
        ),
    )
    measured = [frame for frame in there if frame.file("depth") in files]
    if measured and len(measured) < len(there):
        remark(path, f"{len(there) - len(measured)} of {amount(len(there), 'frame')} have no depth")
    posed = [frame for frame in there if frame.T_world_camera is not None]
    if not posed:
        raise metadata.error("no pose is finite", expected="qx qy qz qw tx ty tz of each frame")
    if len(posed) < len(there):
        remark(
            path, f"{len(there) - len(posed)} of {amount(len(there), 'frame')} have no pose and are left out"
        )
    return posed


def _pose(metadata: Record, number: int, numbers: Any) -> SE3 | None:
    where = f"{metadata.where}: pose {number}"
    if not isinstance(numbers, list) or len(numbers) != 7 or not all(_is_number(value) for value in numbers):
        raise InputError("is not 7 numbers", where=where, expected="qx qy qz qw tx ty tz")
    return pose_of_numbers(where, numbers, opengl=True)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _times(metadata: Record, count: int) -> list[float | None]:
    """Return the frame times, from their stamps or from the rate."""
    stamps = metadata.items("frameTimestamps")
    if stamps is not None and len(stamps) >= count:
        return [metadata.checked_number(stamp, "an entry of frameTimestamps") for stamp in stamps[:count]]
    fps = metadata.number("fps")
    return [number / fps if fps else None for number in range(count)]


def _cameras(metadata: Record, count: int) -> list[Intrinsics]:
    """Return the cameras of the frames: their own, or the first frame's for all."""
    width, height = metadata.size("w"), metadata.size("h")
    if width is None or height is None:
        raise metadata.error("no w and h", expected="the size of the photos")
    own, shared = metadata.items("perFrameIntrinsicCoeffs"), metadata.items("K")
    if own is not None and len(own) >= count:
        rows = [row if isinstance(row, list) else [] for row in own[:count]]
    elif shared is not None and len(shared) == 9:
        rows = [[shared[0], shared[4], shared[6], shared[7]]] * count  # column by column
    else:
        raise metadata.error("no K with 9 numbers", expected="the intrinsics")
    return [_camera(metadata, row, width, height) for row in rows]


def _camera(metadata: Record, row: list[Any], width: int, height: int) -> Intrinsics:
    if len(row) < 4:
        raise metadata.error(f"perFrameIntrinsicCoeffs has {row}", expected="fx fy cx cy")
    fx, fy, cx, cy = (metadata.checked_number(value, "an entry of the intrinsics") for value in row[:4])
    try:
        return Intrinsics(fx, fy, cx + CENTRE_OF_PIXEL, cy + CENTRE_OF_PIXEL, width, height)
    except InputError as error:
        raise metadata.error(error) from error


reader = Record3DReader()
