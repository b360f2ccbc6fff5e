"""Files of estimated poses: TUM trajectories, JSON with covariances, and ``transforms.json`` for nerfstudio."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from kornia.geometry.conversions import rotation_matrix_to_quaternion
from torch import Tensor

from bidnerf_core.camera.exif import read_exif
from bidnerf_core.camera.intrinsics import Intrinsics
from bidnerf_core.camera.orientation import UPRIGHT, Orientation
from bidnerf_core.datasets.writing import OPENCV_TO_OPENGL, camera_entry
from bidnerf_core.errors import InputError
from bidnerf_core.geometry.se3 import SE3
from bidnerf_core.io.files import write_file

TUM_HEAD = "# timestamp tx ty tz qx qy qz qw (camera to world, OpenCV axes)\n"
NUMBER = re.compile(r"\d+(\.\d+)?")


@dataclass(frozen=True, eq=False)
class PosedImage:
    """An image with its camera and an estimated pose."""

    name: str
    number: int  # index in the run or sequence, from 0; it serves as the timestamp where names are not times
    intrinsics: Intrinsics  # of the upright image
    T_world_camera: SE3  # OpenCV axes
    file: Path | None = None
    time: float | None = None  # seconds
    covariance: Float[Tensor, "6 6"] | None = (
        None  # of the tangent at the camera (translation in metres, rotation in rad)
    )


def tum_trajectory(images: Sequence[PosedImage]) -> str:
    """Return rows ``timestamp tx ty tz qx qy qz qw`` (metres, unit quaternions with the scalar last).

    The timestamp is the image's time if all have one, else its name if all names are numbers, as in the TUM RGB-D datasets,
    else the image's number (https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats).
    """
    stamps = _timestamps(images)
    rows = (_tum_row(stamp, image.T_world_camera) for stamp, image in zip(stamps, images, strict=True))
    return TUM_HEAD + "".join(rows)


def _timestamps(images: Sequence[PosedImage]) -> list[str]:
    times = [image.time for image in images if image.time is not None]
    if len(times) == len(images):
        return [f"{time:.6f}" for time in times]
    named = all(NUMBER.fullmatch(image.name) for image in images)
    return [image.name if named else str(image.number) for image in images]


def _tum_row(timestamp: str, T_world_camera: SE3) -> str:
    pose = T_world_camera.to("cpu", torch.float64)
    w, x, y, z = _quaternion(pose.rotation).tolist()
    numbers = (*pose.translation.tolist(), x, y, z, w)
    return " ".join((timestamp, *(f"{number:.12g}" for number in numbers))) + "\n"


def _quaternion(rotation: Float[Tensor, "3 3"]) -> Float[Tensor, "4"]:
    """Return the unit quaternion (w, x, y, z) of a rotation with w >= 0."""
    quaternion = torch.nn.functional.normalize(rotation_matrix_to_quaternion(rotation), dim=-1)
    return -quaternion if float(quaternion[0]) < 0 else quaternion


def transforms_json(images: Sequence[PosedImage], folder: Path) -> str:
    """Return a ``transforms.json`` for ``folder``: poses with OpenGL axes, one camera each, ``file_path`` relative to it.

    It describes the image files as they are stored, so the poses and cameras of photos with an EXIF orientation are rotated.
    Raises ``InputError`` for a photo that is stored mirrored, for which no rigid pose exists.
    """
    frames = [_transforms_entry(image, folder) for image in images]
    return json.dumps({"camera_model": "OPENCV", "frames": frames}, indent=1, allow_nan=False) + "\n"


def _transforms_entry(image: PosedImage, folder: Path) -> dict[str, Any]:
    orientation = UPRIGHT if image.file is None else read_exif(image.file).orientation
    intrinsics, pose = _as_stored(image, orientation)
    matrix = pose.matrix()
    place = image.name if image.file is None else os.path.relpath(image.file.resolve(), folder.resolve())
    return {
        "file_path": Path(place).as_posix(),
        "transform_matrix": (matrix * matrix.new_tensor(OPENCV_TO_OPENGL)).tolist(),
        **({} if image.time is None else {"time": image.time}),
        **camera_entry(intrinsics, image.name),
    }


def poses_json(images: Sequence[PosedImage]) -> str:
    """Return a JSON list of ``{"frame", "time", "T_world_camera", "covariance"}``, one per line; poses have OpenCV axes.

    ``time`` (seconds) and ``covariance`` (6x6, tangent of translation in metres, then rotation in rad, at the camera) are
    null where they are not known.
    """
    objects = [
        {
            "frame": image.name,
            "time": image.time,
            "T_world_camera": image.T_world_camera.to("cpu", torch.float64).matrix().tolist(),
            "covariance": None if image.covariance is None else image.covariance.double().cpu().tolist(),
        }
        for image in images
    ]
    return "[\n" + ",\n".join(json.dumps(entry, allow_nan=False) for entry in objects) + "\n]\n"


def _as_stored(image: PosedImage, orientation: Orientation) -> tuple[Intrinsics, SE3]:
    """Return the camera and the pose (float64) of the image as its file stores it."""
    pose = image.T_world_camera.to("cpu", torch.float64)
    if orientation == UPRIGHT:
        return image.intrinsics, pose
    # The columns are the stored image's axes in the upright camera's frame.
    x, y = (-1.0 if flips else 1.0 for flips in (orientation.mirrors_columns, orientation.mirrors_rows))
    axes = [[0.0, y, 0.0], [x, 0.0, 0.0]] if orientation.transposes else [[x, 0.0, 0.0], [0.0, y, 0.0]]
    turn = torch.tensor([*axes, [0.0, 0.0, 1.0]], dtype=torch.float64)
    if float(torch.linalg.det(turn)) < 0:
        raise InputError(f"{image.file}: is stored as a mirror image, which no transforms.json can describe")
    inverse = Orientation(orientation.mirrors_columns, orientation.mirrors_rows)
    if orientation.transposes:
        inverse = Orientation(orientation.mirrors_rows, orientation.mirrors_columns, True)
    return image.intrinsics.upright(inverse), pose @ SE3(turn, torch.zeros(3, dtype=torch.float64))


def write_tum(path: Path, images: Sequence[PosedImage]) -> None:
    """Write ``tum_trajectory``, whole or not at all."""
    write_file(path, tum_trajectory(images).encode())


def write_pose_json(path: Path, images: Sequence[PosedImage]) -> None:
    """Write ``poses_json``, whole or not at all."""
    write_file(path, poses_json(images).encode())


def write_pose_transforms(path: Path, images: Sequence[PosedImage]) -> None:
    """Write ``transforms_json``, whole or not at all."""
    write_file(path, transforms_json(images, path.parent).encode())


POSE_WRITERS: dict[str, Callable[[Path, Sequence[PosedImage]], None]] = {
    "transforms.json": write_pose_transforms,
    ".json": write_pose_json,
    ".txt": write_tum,
    ".tum": write_tum,
}
"""Writers by the ending of the file's name; the first that matches is used."""


def write_poses(path: Path, images: Sequence[PosedImage]) -> None:
    """Write poses in the format that the ending of the file's name selects. Raises ``InputError`` for an unknown ending."""
    for ending, write in POSE_WRITERS.items():
        if path.name.lower().endswith(ending):
            write(path, images)
            return
    raise InputError(f"{path}: expected a name that ends with {', '.join(POSE_WRITERS)}")
