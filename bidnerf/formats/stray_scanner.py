"""Recordings of the iOS app Stray Scanner (https://github.com/strayrobots/scanner, docs/format.md).

``rgb.mp4`` is a video; ``odometry.csv`` has ``timestamp, frame, x, y, z, qx, qy, qz, qw`` of its frames
(seconds, metres; camera to world with OpenCV axes) and in newer recordings ``fx, fy, cx, cy``;
``camera_matrix.csv`` is the 3x3 camera matrix of all frames. ``depth/000000.png`` (16-bit planar z in
millimetres, 256x192) and ``confidence/000000.png`` (0, 1, 2) belong to the frame with that number; some may
be missing. See ``lidar`` for how depth and photos are read. Reading the video needs the extra ``video``.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

from bidnerf.formats import lidar
from bidnerf.formats.ace import read_matrix
from bidnerf_core.datasets import (
    Capture,
    DatasetOptions,
    DepthFile,
    Format,
    Shot,
    Video,
    VideoPicture,
    camera_of,
    first_file,
    pose_of_numbers,
    read_table,
)
from bidnerf_core.io import is_file

POSE_COLUMNS = ("x", "y", "z", "qx", "qy", "qz", "qw")
LENS = ("fx", "fy", "cx", "cy")


def _read(path: Path, odometry: Path, options: DatasetOptions) -> Capture:
    """Read a recording: its odometry, its camera matrix, and references to its video frames and depth images.

    The app leaves cells empty where a pose or the intrinsics are unknown; distortion columns are ignored. Raises ``InputError``
    if a file is invalid, and if the extra ``video`` is missing.
    """
    video, read, shots = Video(path / "rgb.mp4"), lidar.LidarDepth(), list[Shot]()
    columns = "timestamp, frame, x, y, z, qx, qy, qz, qw"
    rows = read_table(odometry, "Stray Scanner's odometry", columns, {"timestamp", "frame", *POSE_COLUMNS})
    of_all = read_matrix(path / "camera_matrix.csv", video.size)
    for row, words in rows:
        number = row.integer(words["frame"])
        own = row.plain_numbers([words[key] for key in LENS]) if all(map(words.get, LENS)) else None
        stem = f"{number:06d}"
        pose = row.plain_numbers([words[name] or "nan" for name in POSE_COLUMNS])
        # The first versions wrote depth as .npy.
        depth = first_file(path / "depth", f"{stem}.png", f"{stem}.npy")
        shots.append(
            Shot(
                image=VideoPicture(video, number) if number < len(video) else video.path / stem,
                camera=of_all if own is None else camera_of(row.where, own, video.size),
                T_world_camera=pose_of_numbers(row.where, pose, opengl=False),
                time=row.plain_numbers([words["timestamp"]])[0],
                depth=None
                if depth is None
                else DepthFile(depth, partial(read, depth, first_file(path / "confidence", f"{stem}.png"))),
                stem=stem,
                folders=(),
                usual_side=lidar.LARGEST_SIDE,
            )
        )
    return Capture(
        path,
        shots,
        options.colour,
        unit="metres",
        up=lidar.UP,
        pose_file=odometry,
        rate=lidar.FRAMES_PER_SECOND,
        poses_expected="a finite one for each frame",
    )


reader = Format(
    "Stray Scanner: depth of confidence 2 up to 5 m (extra 'video')",
    "rgb.mp4 with odometry.csv and camera_matrix.csv (Stray Scanner)",
    lambda path: first_file(path, "odometry.csv") if is_file(path / "camera_matrix.csv") else None,
    _read,
    precedence=30,  # a recording with metric poses
)
