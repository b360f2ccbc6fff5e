"""Sequences of KITTI's odometry benchmark (https://www.cvlibs.net/datasets/kitti/eval_odometry.php).

``calib.txt`` has the projection matrices ``P0`` to ``P3`` (3x4) of the rectified cameras, ``times.txt`` the
times (seconds), and ``image_2/000000.png`` ... the images of camera 2, the left colour camera; the first
existing folder of ``image_2``, ``image_0``, ``image_3`` and ``image_1`` is used. Poses are rows of twelve
numbers (3x4, camera 0 to world, OpenCV axes, metres) in the folder's ``poses.txt`` or, as distributed, in
``../../poses/NN.txt`` for the sequence ``NN``; they are transformed to the camera whose images are used.
Principal points are relative to the centre of the upper left pixel, so half a pixel is added. Every eighth
image (the first, the ninth ...) is held out as "test" and the others are "train".
"""

from __future__ import annotations

from pathlib import Path

import torch

from bidnerf_core.camera import Intrinsics
from bidnerf_core.datasets.capture import Capture, Shot, remark
from bidnerf_core.datasets.reader import DatasetOptions, Reader
from bidnerf_core.datasets.trajectories import read_matrices
from bidnerf_core.errors import InputError, amount
from bidnerf_core.frames import natural_order
from bidnerf_core.geometry import SE3
from bidnerf_core.io import IMAGE_SUFFIXES, is_file, read_header, read_rows

CALIBRATION = "calib.txt"
CAMERAS = (2, 0, 3, 1)
"""Camera numbers, in the order in which their images are looked for."""


class KittiReader(Reader):
    """Reader for sequences of KITTI's odometry benchmark."""

    expected = "calib.txt with image_2 or image_0 (KITTI odometry)"

    def recognises(self, path: Path) -> bool:
        return is_file(path / CALIBRATION) and _number(path) is not None

    def read(self, path: Path, options: DatasetOptions) -> Capture:
        """Read the lists. Raises ``InputError`` if one is invalid."""
        number, name = _number(path), path.resolve().name
        folder = path / f"image_{number}"
        images = [
            file
            for file in folder.iterdir()
            if file.suffix.lower() in IMAGE_SUFFIXES and file.stem.isdecimal()
        ]
        if number is None or not images:
            raise InputError("has no images", where=folder, expected="000000.png ...")
        images.sort(key=lambda file: natural_order(file.name))
        header = read_header(images[0])
        camera, T_first_camera = _calibration(path / CALIBRATION, number, header.width, header.height)
        places = (
            path / "poses.txt",
            path / f"{name}.txt",
            path.resolve().parent.parent / "poses" / f"{name}.txt",
        )
        file = next((place for place in places if is_file(place)), None)
        poses = dict(enumerate([] if file is None else read_matrices(file)))
        times = dict(enumerate(_times(path / "times.txt")))
        listed = max(len(poses), len(times))
        gone = sorted(set(range(listed)) - {int(image.stem) for image in images})
        if gone:
            remark(path, f"{len(gone)} of {amount(listed, 'image')} are missing, first: number {gone[0]}")
        shots = [
            Shot(
                image=image,
                camera=camera,
                T_world_camera=poses[index] @ T_first_camera if index in poses else None,
                time=times.get(index),
            )
            for index, image in ((int(image.stem), image) for image in images)  # the name is the number
        ]
        return Capture(
            path, shots, options.colour, unit="metres", pose_file=file,
            poses_expected=f"poses.txt in it, or ../../poses/{name}.txt",
        )  # fmt: skip


def _number(path: Path) -> int | None:
    """Return the number of the camera whose images are used."""
    return next((number for number in CAMERAS if (path / f"image_{number}").is_dir()), None)


def _calibration(file: Path, number: int, width: int, height: int) -> tuple[Intrinsics, SE3]:
    """Return a camera, and its pose in camera 0. Raises ``InputError`` if the file lacks it."""
    for row in read_rows(file, "KITTI's calib.txt", "P0: 12 numbers"):
        name, _, text = row.text.partition(":")
        if name.strip() == f"P{number}":
            projection = torch.tensor(row.numbers(text.split(), 12), dtype=torch.float64).reshape(3, 4)
            shift = torch.linalg.solve(projection[:, :3], projection[:, 3])
            fx, fy, cx, cy = (float(projection[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
            camera = Intrinsics(fx, fy, cx + 0.5, cy + 0.5, width, height)
            return camera, SE3(torch.eye(3, dtype=torch.float64), -shift)
    raise InputError(f"has no row P{number}", where=file, expected=f"the projection matrix of image_{number}")


def _times(file: Path) -> list[float]:
    if not is_file(file):
        return []
    return [row.numbers(count=1)[0] for row in read_rows(file, "KITTI's times.txt", "a time in seconds")]


reader = KittiReader()
