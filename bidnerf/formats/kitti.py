"""Sequences of KITTI's odometry benchmark (https://www.cvlibs.net/datasets/kitti/eval_odometry.php).

``calib.txt`` has the projection matrices ``P0`` to ``P3`` (3x4) of the rectified cameras, ``times.txt`` the
times (seconds), and ``image_2/000000.png`` ... the images of camera 2, the left colour camera; the first
existing folder of ``image_2``, ``image_0``, ``image_3`` and ``image_1`` is used. Poses are rows of twelve
numbers (3x4, camera 0 to world, OpenCV axes, metres) in the folder's ``poses.txt`` or, as distributed, in
``../../poses/NN.txt`` for the sequence ``NN``; they are transformed to the camera whose images are used.
Principal points are relative to the centre of the upper left pixel, so half a pixel is added.
"""

from __future__ import annotations

from pathlib import Path

import torch

from bidnerf.formats.layouts import Layout
from bidnerf_core.camera import Intrinsics
from bidnerf_core.datasets import (
    Capture,
    DatasetOptions,
    Format,
    camera_of,
    first_file,
    read_matrices,
    warn_about,
)
from bidnerf_core.errors import InputError, amount
from bidnerf_core.geometry import SE3
from bidnerf_core.io import is_file, read_header, read_rows

KITTI = Layout(
    tuple((f"image_{number}",) for number in (2, 0, 3, 1)),  # the left colour camera first
    image=r"(\d+)\.\w+",
    camera=("../calib.txt",),
)


def _read(path: Path, images: list[Path], options: DatasetOptions) -> Capture:
    """Read the lists. Raises ``InputError`` if one is invalid."""
    number, sequence, stamps = images[0].parent.name.removeprefix("image_"), path.resolve(), path / "times.txt"
    camera, T_first_camera = _calibration(path / "calib.txt", f"P{number}", read_header(images[0]).size)
    name = f"{sequence.name}.txt"
    file = first_file(path, "poses.txt", name, f"{sequence.parent.parent}/poses/{name}")
    poses = [] if file is None else [T @ T_first_camera for T in read_matrices(file)]
    rows = read_rows(stamps, "KITTI's times.txt", "a time in seconds") if is_file(stamps) else []
    numbers = [int(image.stem) for image in images]
    listed = max(len(poses), len(rows))
    if gone := sorted(set(range(listed)).difference(numbers)):
        warn_about(path, f"{len(gone)} of {amount(listed, 'image')} are missing, first: number {gone[0]}")
    by_name = {i.stem: poses[n] for i, n in zip(images, numbers, strict=True) if n < len(poses)}
    times = {i.stem: rows[n].numbers(count=1)[0] for i, n in zip(images, numbers, strict=True) if n < len(rows)}
    shots = KITTI.shots(images, camera, poses=by_name, times=times)
    return Capture(
        path, shots, options.colour, "metres", pose_file=file, poses_expected=f"poses.txt in it, or ../../poses/{name}"
    )


def _calibration(file: Path, camera: str, size: tuple[int, int]) -> tuple[Intrinsics, SE3]:
    """Return a camera and its pose in camera 0's frame. Raises ``InputError`` if the file lacks the camera."""
    rows = {row.text.partition(":")[0].strip(): row for row in read_rows(file, "KITTI's calib.txt", "P0: 12 numbers")}
    if camera not in rows:
        raise InputError(f"has no row {camera}", where=file, expected="the projection matrix of the images")
    row = rows[camera]
    projection = torch.tensor(row.numbers(row.text.partition(":")[2].split(), 12), dtype=torch.float64).reshape(3, 4)
    if not abs(float(torch.linalg.det(projection[:, :3]))) > 0:
        raise row.error(": the matrix projects no image")
    shift = torch.linalg.solve(projection[:, :3], projection[:, 3])
    numbers = [float(projection[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2))]
    return camera_of(row.where, numbers, size), SE3(torch.eye(3, dtype=torch.float64), -shift)


reader = Format(
    "KITTI odometry: poses of poses.txt or ../../poses/NN.txt, times of times.txt",
    "calib.txt with image_2 or image_0 (KITTI odometry)",
    KITTI.images,
    _read,
    may_lack_poses=True,
    precedence=30,  # a recording with metric poses
)
