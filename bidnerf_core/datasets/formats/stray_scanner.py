"""Recordings of the iOS app Stray Scanner (https://github.com/strayrobots/scanner, docs/format.md).

``rgb.mp4`` is a video, ``odometry.csv`` has ``timestamp, frame, x, y, z, qx, qy, qz, qw`` of its frames
(seconds, metres; camera to world with OpenCV axes) and in newer recordings ``fx, fy, cx, cy``,
``camera_matrix.csv`` is the 3x3 camera matrix of all frames. ``depth/000000.png`` (16-bit planar z in
millimetres, 256x192) and ``confidence/000000.png`` (0, 1, 2) belong to the frame with that number; some may
be missing. See ``lidar`` for how depth and photos are read. Reading the video needs the extra
``video``. Every eighth frame of the dataset (the first, the ninth ...) is held out as "test" and the others
are "train".
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

from bidnerf_core.datasets import lidar
from bidnerf_core.datasets.capture import Capture, DepthFile, Shot, present, remark
from bidnerf_core.datasets.reader import DatasetOptions, Reader
from bidnerf_core.datasets.video import Video, VideoPicture
from bidnerf_core.errors import InputError
from bidnerf_core.io import Row, is_file, read_lines, read_rows

VIDEO, ODOMETRY, MATRIX = "rgb.mp4", "odometry.csv", "camera_matrix.csv"
POSE = ("qx", "qy", "qz", "qw", "x", "y", "z")
LENS = ("fx", "fy", "cx", "cy")
NEEDED = ("timestamp", "frame", *POSE)


class StrayScannerReader(Reader):
    """Reader for Stray Scanner recordings."""

    expected = f"{VIDEO} with {ODOMETRY} and {MATRIX} (Stray Scanner)"

    def recognises(self, path: Path) -> bool:
        return is_file(path / ODOMETRY) and is_file(path / MATRIX)

    def read(self, path: Path, options: DatasetOptions) -> Capture:
        """Read the odometry. Raises ``InputError`` if a file is invalid, and if the extra ``video`` is missing."""
        video, read = Video(path / VIDEO), lidar.LidarDepth()
        names, rows = _odometry(path / ODOMETRY)
        matrix = _matrix(path / MATRIX)
        shots = [
            _shot(path, row, dict(zip(names, words, strict=False)), matrix, video, read)
            for row, words in rows
        ]
        there = present(
            shots,
            lambda shot: int(shot.stem) < len(video),
            path / VIDEO,
            lambda shot: f"frame {int(shot.stem)}",
            lambda shot: InputError(
                f"has {len(video)} frames, but frame {int(shot.stem)} is needed", where=video.path
            ),
            noun="frame",
        )
        up = (0.0, 1.0, 0.0)  # ARKit aligns its world with gravity
        return Capture(
            path, lidar.thinned(path, there), options.colour, unit="metres", up=up, pose_file=path / ODOMETRY,
            poses_expected="a finite one for each frame",
        )  # fmt: skip


def _odometry(file: Path) -> tuple[list[str], list[tuple[Row, list[str]]]]:
    """Return the names of the columns, and the rows with their words; a truncated last row is left out with a remark."""
    first, *rows = read_lines(file, "Stray Scanner's odometry", "timestamp, frame, x, y, z, qx, qy, qz, qw")
    names = [name.strip() for name in first.text.split(",")]
    if not set(NEEDED) <= set(names):
        raise first.error(f" has the columns {first.text[:60]!r}")
    found = [(row, [word.strip() for word in row.text.split(",")]) for row in rows if row.text]
    if len(found) > 1 and len(found[-1][1]) < len(names):
        remark(found[-1][0].where, "the last row is truncated and was left out")
        found = found[:-1]
    for row, words in found:
        if len(words) < len(names):
            raise row.error(f" has {len(words)} of {len(names)} entries")
    if not found:
        raise InputError("has no rows", where=file, expected="one for each frame")
    return names, found


def _shot(
    path: Path, row: Row, words: dict[str, str], matrix: list[float], video: Video, read: lidar.LidarDepth
) -> Shot:
    """Return the frame of a row of the odometry, in which the app leaves cells empty: those of an unknown pose or lens, and
    those of the distortion, which are not read.
    """
    number, (time,) = row.integer(words["frame"]), row.plain_numbers([words["timestamp"]])
    pose = row.plain_numbers([words[name] or "nan" for name in POSE])
    lens = (
        row.plain_numbers([words[name] for name in LENS]) if all(words.get(name) for name in LENS) else matrix
    )
    files = {kind: path / kind / f"{number:06d}.png" for kind in ("depth", "confidence")}
    arrays = files["depth"].with_suffix(".npy")  # written by the first versions
    depth = next((file for file in (files["depth"], arrays) if is_file(file)), None)
    sure = files["confidence"] if is_file(files["confidence"]) else None
    return Shot(
        image=VideoPicture(video, number),
        camera=lidar.arkit_camera(lens, *video.size, row.where if lens is not matrix else str(path / MATRIX)),
        T_world_camera=lidar.pose_of_numbers(row.where, pose, opengl=False),
        time=time,
        depth=None if depth is None else DepthFile(depth, partial(read, depth, sure)),
        stem=f"{number:06d}",
        usual_side=lidar.LARGEST_SIDE,
    )


def _matrix(file: Path) -> list[float]:
    """Return fx, fy, cx and cy of the whole recording."""
    rows = [
        row.numbers(row.text.replace(",", " ").split(), 3)
        for row in read_rows(file, "Stray Scanner's camera matrix", "3 rows of 3 numbers")
    ]
    if len(rows) != 3:
        raise InputError(f"has {len(rows)} rows", where=file, expected="3 of 3 numbers")
    return [rows[0][0], rows[1][1], rows[0][2], rows[1][2]]


reader = StrayScannerReader()
