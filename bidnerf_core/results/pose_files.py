"""Files of estimated poses: TUM trajectories, JSON with covariances, and ``transforms.json`` for nerfstudio."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import torch
from jaxtyping import Float
from kornia.geometry.conversions import rotation_matrix_to_quaternion
from torch import Tensor

from bidnerf_core.camera.exif import read_exif
from bidnerf_core.camera.intrinsics import Intrinsics
from bidnerf_core.camera.orientation import UPRIGHT, Orientation
from bidnerf_core.datasets.writing import OPENCV_TO_OPENGL, camera_entry
from bidnerf_core.errors import InputError, UsageError
from bidnerf_core.geometry.se3 import SE3, pose_from_matrix
from bidnerf_core.io.files import read_file, write_file
from bidnerf_core.io.json import parse_json
from bidnerf_core.registry import Plugins, interface_defects

TUM_HEAD = "# timestamp tx ty tz qx qy qz qw (camera to world, OpenCV axes)\n"
EXPECTED_POSE = '{"T_world_camera": 4x4 rows}'
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
    _require_finite(images)
    stamps = _timestamps(images)
    rows = (_tum_row(stamp, image.T_world_camera) for stamp, image in zip(stamps, images, strict=True))
    return TUM_HEAD + "".join(rows)


def _require_finite(images: Sequence[PosedImage]) -> None:
    for image in images:
        if not bool(image.T_world_camera.matrix().isfinite().all()):
            raise InputError(
                f"the pose of {image.name} is not finite, expected to leave it out, or a .json file"
            )


def _timestamps(images: Sequence[PosedImage]) -> list[str]:
    times = [image.time for image in images if image.time is not None]
    if len(times) == len(images):
        return [f"{time:.6f}" for time in times]
    named = all(NUMBER.fullmatch(image.name) for image in images)
    return [image.name if named else str(image.number) for image in images]


def _tum_row(timestamp: str, T_world_camera: SE3) -> str:
    pose = T_world_camera.to("cpu", torch.float64)
    w, x, y, z = quaternion_of(pose.rotation).tolist()
    numbers = (*pose.translation.tolist(), x, y, z, w)
    return " ".join((timestamp, *(f"{number:.12g}" for number in numbers))) + "\n"


def quaternion_of(rotation: Float[Tensor, "3 3"]) -> Float[Tensor, "4"]:
    """Return the unit quaternion (w, x, y, z) of a rotation with w >= 0."""
    quaternion = torch.nn.functional.normalize(rotation_matrix_to_quaternion(rotation), dim=-1)
    return -quaternion if float(quaternion[0]) < 0 else quaternion


def transforms_json(images: Sequence[PosedImage], folder: Path) -> str:
    """Return a ``transforms.json`` for ``folder``: poses with OpenGL axes, one camera each, ``file_path`` relative to it.

    It describes the image files as they are stored, so the poses and cameras of photos with an EXIF orientation are rotated.
    Raises ``InputError`` for a photo that is stored mirrored, for which no rigid pose exists.
    """
    _require_finite(images)
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
    null where they are not known, and every matrix is null where it is not finite.
    """
    objects = [
        {
            "frame": image.name,
            "time": image.time,
            "T_world_camera": _rows(image.T_world_camera.matrix()),
            "covariance": None if image.covariance is None else _rows(image.covariance),
        }
        for image in images
    ]
    return "[\n" + ",\n".join(json.dumps(entry, allow_nan=False) for entry in objects) + "\n]\n"


def _rows(matrix: Float[Tensor, "r c"]) -> list[list[float]] | None:
    return matrix.double().cpu().tolist() if bool(matrix.isfinite().all()) else None


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
    """Write a TUM trajectory: rows of time, position and unit quaternion."""
    write_file(path, tum_trajectory(images).encode())


def write_pose_json(path: Path, images: Sequence[PosedImage]) -> None:
    """Write JSON: a list of frames with poses and covariances."""
    write_file(path, poses_json(images).encode())


def write_pose_transforms(path: Path, images: Sequence[PosedImage]) -> None:
    """Write a transforms.json as nerfstudio reads it: poses with OpenGL axes, and cameras."""
    write_file(path, transforms_json(images, path.parent).encode())


def _defects(writer: Any) -> Iterator[str]:
    yield from interface_defects(writer, (), {"__call__": ("path", "images")})


PoseWriter: TypeAlias = Callable[[Path, Sequence[PosedImage]], None]
"""A function that writes poses to a file, whole or not at all."""

POSE_WRITERS: Plugins[PoseWriter] = Plugins(
    "writers", _defects, first=("transforms.json", ".json", ".txt", ".tum", ".kitti.txt", ".euroc.csv")
)
"""Writers by the ending of the file's name; where several match, the longest ending is used."""


def pose_format(path: Path) -> str:
    """Return the ending that selects the format of a file of poses. Raises ``UsageError`` for a name without any of them."""
    found = max((e for e in POSE_WRITERS if path.name.lower().endswith(e)), key=len, default=None)
    if found is None:
        raise UsageError(f"{path}: expected a name that ends with {', '.join(POSE_WRITERS)}")
    return found


def write_poses(path: str | Path, images: Sequence[PosedImage]) -> None:
    """Write poses in the format that the ending of the file's name selects.

    Raises ``InputError`` for an unknown ending, and for images that are not ``PosedImage``.
    """
    path = Path(path)
    strange = (
        [image for image in images if not isinstance(image, PosedImage)]
        if isinstance(images, Sequence)
        else [images]
    )
    if strange:
        found = type(strange[0]).__name__
        raise InputError(
            f"{path}: got a {found}, expected a list of PosedImage(name, number, intrinsics, T_world_camera)"
        )
    POSE_WRITERS[pose_format(path)](path, images)


def read_pose(path: str | Path) -> SE3:
    """Read a 4x4 camera-to-world matrix, alone or under "T_world_camera", as ``localize --json`` prints it.

    A list of one such object is accepted as well. Raises ``InputError`` where the file does not hold the rows of a rigid
    transform.
    """
    path = Path(path)
    content = read_file(path, "a pose file")
    try:
        found = parse_json(content, str(path), EXPECTED_POSE)
    except InputError as error:
        lines = [line for line in content.splitlines() if line.strip()]
        if len(lines) > 1 and all(line.startswith(b"{") for line in lines):  # as ``--json`` prints several
            raise _not_one(path, len(lines)) from error
        raise
    if isinstance(found, list) and all(isinstance(entry, dict) for entry in found):
        if len(found) != 1:  # as ``--out`` writes several
            raise _not_one(path, len(found))
        (found,) = found
    rows = found.get("T_world_camera") if isinstance(found, dict) else found
    try:
        matrix = torch.tensor(rows, dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError, OverflowError) as error:
        raise InputError(f"{path}: no matrix of numbers in it, expected {EXPECTED_POSE}") from error
    return pose_from_matrix(matrix, f"{path}: T_world_camera")


def _not_one(path: Path, count: int) -> InputError:
    return InputError(f"{path}: holds {count} poses, expected one")
