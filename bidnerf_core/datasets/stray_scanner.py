"""Recordings of the iOS app Stray Scanner (https://github.com/strayrobots/scanner, docs/format.md).

``rgb.mp4`` is a video, ``odometry.csv`` has ``timestamp, frame, x, y, z, qx, qy, qz, qw`` of its frames
(seconds, metres; camera to world with OpenCV axes) and in newer recordings ``fx, fy, cx, cy``,
``camera_matrix.csv`` is the 3x3 camera matrix of all frames. ``depth/000000.png`` (16-bit planar z in
millimetres, 256x192) and ``confidence/000000.png`` (0, 1, 2) belong to the frame with that number; some may
be missing. See ``phone_scans`` for how depth and photos are read. Reading the video needs the extra
``video``. Every eighth frame of the dataset (the first, the ninth ...) is held out as "test" and the others
are "train".
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

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
from bidnerf_core.datasets.video_frames import VideoFrames
from bidnerf_core.depth import MILLIMETRE, read_depth_image
from bidnerf_core.errors import InputError, amount
from bidnerf_core.frames import Frame
from bidnerf_core.geometry import SE3, LengthUnit
from bidnerf_core.io import Background, Row, decode, is_file, read_lines, read_rows

VIDEO, ODOMETRY, MATRIX = "rgb.mp4", "odometry.csv", "camera_matrix.csv"
POSE = ("qx", "qy", "qz", "qw", "x", "y", "z")
LENS = ("fx", "fy", "cx", "cy")


@dataclass(frozen=True, eq=False)
class StrayFrame:
    """A frame of the video."""

    number: int
    time: float
    camera: Intrinsics  # of the video
    T_world_camera: SE3 | None

    @property
    def stem(self) -> str:
        return f"{self.number:06d}"

    @property
    def parts(self) -> tuple[str, ...]:
        return (self.stem,)


class StrayScannerReader(Reader):
    """Reader for Stray Scanner recordings."""

    expected = f"{VIDEO} with {ODOMETRY} and {MATRIX} (Stray Scanner)"

    def recognises(self, path: Path) -> bool:
        return is_file(path / ODOMETRY) and is_file(path / MATRIX)

    def open(self, path: Path, options: ReadOptions) -> Dataset:
        """Read the odometry. Raises ``InputError`` if a file is invalid, and if the extra ``video`` is missing."""
        return self._open(path, options)[0]

    def open_sequence(self, path: Path, options: ReadOptions) -> FrameSequence:
        dataset, others = self._open(path, options)
        return dataset.sequence(others)

    def _open(self, path: Path, options: ReadOptions) -> tuple[StrayDataset, list[StrayFrame]]:
        video = VideoFrames(path / VIDEO)
        kept, others = thinned(path, _frames(path, video))
        return StrayDataset(Splits(path, hold_out(kept)), video, options.background), others


class StrayDataset(SplitDataset[StrayFrame]):
    """Views of a recording; see ``Dataset``."""

    unit: LengthUnit | None = "metres"
    up: tuple[float, float, float] | None = (0.0, 1.0, 0.0)  # ARKit aligns its world with gravity

    def __init__(self, frames: Splits[StrayFrame], video: VideoFrames, background: Background | None) -> None:
        super().__init__(frames, background)
        self._video, self._sure = video, SureDepth()

    def _pose(self, frame: StrayFrame) -> SE3 | None:
        return frame.T_world_camera

    def _frame(self, frame: StrayFrame, name: str) -> Frame:
        rgb = self._video.read(frame.number)
        return scan_frame(
            name, rgb, frame.camera, self._depth(frame), f"{self._video.path}: frame {frame.number}"
        )

    def _depth(self, frame: StrayFrame) -> Measured | None:
        files = {kind: self.path / kind / f"{frame.stem}.png" for kind in ("depth", "confidence")}
        arrays = self.path / "depth" / f"{frame.stem}.npy"  # written by the first versions
        depth = next((file for file in (files["depth"], arrays) if is_file(file)), None)
        if depth is None:
            return None
        measured = read_depth_image(depth, MILLIMETRE)
        sure = decode(files["confidence"]) if is_file(files["confidence"]) else None
        if sure is not None and sure.ndim != 2:
            raise InputError(f"has {sure.shape[-1]} channels", where=files["confidence"], expected="one")
        return Measured(self._sure(measured, sure, str(files["confidence"])), str(depth))


def _frames(path: Path, video: VideoFrames) -> list[StrayFrame]:
    """Return the frames of the odometry that are in the video; remarks count the others."""
    first, *rows = read_lines(
        path / ODOMETRY, "Stray Scanner's odometry", "timestamp, frame, x, y, z, qx, qy, qz, qw"
    )
    names = [name.strip() for name in first.text.split(",")]
    if not {"timestamp", "frame", *POSE} <= set(names):
        raise first.error(f" has the columns {first.text[:60]!r}")
    shared = _matrix(path / MATRIX, video.size)
    rows = [row for row in rows if row.text]
    if len(rows) > 1 and len(rows[-1].text.split(",")) < len(names):
        remark(rows[-1].where, "the last row is truncated and was left out")
        rows = rows[:-1]
    frames = [_frame(row, names, shared) for row in rows]
    if not frames:
        raise InputError("has no rows", where=path / ODOMETRY, expected="one for each frame")
    there = present(
        frames,
        lambda frame: frame.number < len(video),
        path / VIDEO,
        lambda frame: f"frame {frame.number}",
        lambda frame: InputError(
            f"has {len(video)} frames, but frame {frame.number} is needed", where=video.path
        ),
        noun="frame",
    )
    posed = [frame for frame in there if frame.T_world_camera is not None]
    if not posed:
        raise InputError("has no finite pose", where=path / ODOMETRY, expected="one for each frame")
    if len(posed) < len(there):
        remark(
            path / ODOMETRY,
            f"{len(there) - len(posed)} of {amount(len(there), 'frame')} have no pose and are left out",
        )
    return posed


def _frame(row: Row, names: list[str], shared: Intrinsics) -> StrayFrame:
    words = [word.strip() for word in row.text.split(",")]
    if len(words) < len(names):
        raise row.error(f" has {len(words)} of {len(names)} entries")
    values: Mapping[str, float] = dict(zip(names, row.plain_numbers(words[: len(names)]), strict=True))
    pose = pose_of_numbers(row.where, [values[name] for name in POSE], opengl=False)
    camera = shared
    if set(LENS) <= set(names):
        camera = _camera(row.where, [values[name] for name in LENS], (shared.width, shared.height))
    return StrayFrame(row.integer(words[names.index("frame")]), values["timestamp"], camera, pose)


def _matrix(file: Path, size: tuple[int, int]) -> Intrinsics:
    """Return the camera of the whole recording, for the size of the video."""
    rows = [
        row.numbers(row.text.replace(",", " ").split(), 3)
        for row in read_rows(file, "Stray Scanner's camera matrix", "3 rows of 3 numbers")
    ]
    if len(rows) != 3:
        raise InputError(f"has {len(rows)} rows", where=file, expected="3 of 3 numbers")
    return _camera(str(file), [rows[0][0], rows[1][1], rows[0][2], rows[1][2]], size)


def _camera(where: str, numbers: list[float], size: tuple[int, int]) -> Intrinsics:
    fx, fy, cx, cy = numbers
    try:
        return Intrinsics(fx, fy, cx + CENTRE_OF_PIXEL, cy + CENTRE_OF_PIXEL, *size)
    except InputError as error:
        raise InputError(error, where=where) from error


reader = StrayScannerReader()
