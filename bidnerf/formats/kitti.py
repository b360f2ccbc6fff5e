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

from bidnerf_core.camera import Intrinsics
from bidnerf_core.datasets import (
    Capture,
    DatasetOptions,
    Format,
    Shot,
    camera_of,
    first_file,
    read_matrices,
    warn_about,
)
from bidnerf_core.errors import InputError, amount
from bidnerf_core.frames import photos_in
from bidnerf_core.geometry import SE3
from bidnerf_core.io import Row, is_file, read_header, read_rows


def _read(path: Path, folder: Path, options: DatasetOptions) -> Capture:
    """Read the lists. Raises ``InputError`` if one is invalid."""
    images = [file for file in photos_in(folder)[0] if file.stem.isdecimal()]
    if not images:
        raise InputError("has no images", where=folder, expected="000000.png ...")
    header, sequence = read_header(images[0]), path.resolve()
    number = folder.name.removeprefix("image_")
    camera, T_first_camera = _calibration(path / "calib.txt", f"P{number}", (header.width, header.height))
    name = f"{sequence.name}.txt"
    file = first_file(path, "poses.txt", name, f"{sequence.parent.parent}/poses/{name}")
    poses = dict(enumerate([] if file is None else read_matrices(file)))
    stamps, rows = path / "times.txt", list[Row]()
    if is_file(stamps):
        rows = read_rows(stamps, "KITTI's times.txt", "a time in seconds")
    by_number = {int(image.stem): image for image in images}
    times = {number: rows[number].numbers(count=1)[0] for number in by_number if number < len(rows)}
    listed = max(len(poses), len(rows))
    if gone := listed - sum(number < listed for number in by_number):
        first = next(number for number in range(listed) if number not in by_number)
        warn_about(path, f"{gone} of {amount(listed, 'image')} are missing, first: number {first}")
    shots = [
        Shot(
            image=image,
            camera=camera,
            T_world_camera=poses[index] @ T_first_camera if index in poses else None,
            time=times.get(index),
        )
        for index, image in by_number.items()
    ]
    expected = f"poses.txt in it, or ../../poses/{name}"
    return Capture(path, shots, options.colour, "metres", pose_file=file, poses_expected=expected)


def _find(path: Path) -> Path | None:
    """Return the folder of the first camera that has images, the left colour camera before others, or None."""
    if not is_file(path / "calib.txt"):
        return None
    folders = (path / f"image_{number}" for number in (2, 0, 3, 1))
    return next((folder for folder in folders if folder.is_dir()), None)


def _calibration(file: Path, camera: str, size: tuple[int, int]) -> tuple[Intrinsics, SE3]:
    """Return a camera and its pose in camera 0's frame. Raises ``InputError`` if the file lacks the camera."""
    for row in read_rows(file, "KITTI's calib.txt", "P0: 12 numbers"):
        name, _, text = row.text.partition(":")
        if name.strip() == camera:
            projection = torch.tensor(row.numbers(text.split(), 12), dtype=torch.float64).reshape(3, 4)
            if not abs(float(torch.linalg.det(projection[:, :3]))) > 0:
                raise row.error(": the matrix projects no image")
            shift = torch.linalg.solve(projection[:, :3], projection[:, 3])
            numbers = [float(projection[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2))]
            return camera_of(row.where, numbers, size), SE3(torch.eye(3, dtype=torch.float64), -shift)
    raise InputError(f"has no row {camera}", where=file, expected="the projection matrix of the images")


reader = Format(
    "KITTI odometry: poses of poses.txt or ../../poses/NN.txt, times of times.txt",
    "calib.txt with image_2 or image_0 (KITTI odometry)",
    _find,
    _read,
    may_lack_poses=True,
    precedence=30,  # a recording with metric poses
)
