"""Poses as a COLMAP text model: ``images.txt``, with ``cameras.txt`` and an empty ``points3D.txt`` next to
it.

See https://colmap.github.io/format.html. COLMAP's poses are world to camera, quaternions have the scalar
first, and pixel centres are at +0.5, like ours.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from bidnerf_core.camera import UPRIGHT, Intrinsics, colmap_model, read_exif
from bidnerf_core.errors import InputError
from bidnerf_core.geometry import SE3
from bidnerf_core.io import write_file
from bidnerf_core.results.pose_files import PosedImage, as_stored, frame_of, require_finite

HEAD = "# written by bidnerf"


def write_colmap_poses(path: Path, images: Sequence[PosedImage]) -> None:
    """Write ``path`` (images.txt), and the cameras.txt and points3D.txt that COLMAP requires with it.

    Image names are file paths relative to the folder that contains all of them. Raises ``InputError`` for a
    lens that COLMAP cannot describe, and if another program's cameras.txt exists there.
    """
    require_finite(images)
    _check_beside(path)
    names = file_names(images)
    cameras: dict[Intrinsics, int] = {}
    rows = list[str]()
    for number, (image, name) in enumerate(zip(images, names, strict=True), start=1):
        orientation = UPRIGHT if image.file is None else read_exif(image.file).orientation
        intrinsics, T_world_camera = as_stored(image, orientation)
        camera = cameras.setdefault(intrinsics, len(cameras) + 1)
        rows.append(image_rows(number, T_world_camera, camera, name))
    head = f"{HEAD}; {frame_of(images, 'world to camera')}\n"
    listed = "".join(camera_row(number, camera) for camera, number in cameras.items())
    points = "# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)\n"
    write_file(
        path.with_name("cameras.txt"), f"{head}# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n{listed}".encode()
    )
    write_file(path.with_name("points3D.txt"), f"{head}{points}".encode())
    columns = "# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME, then an empty line\n"
    write_file(path, f"{head}{columns}{''.join(rows)}".encode())


def image_rows(number: int, T_world_camera: SE3, camera: int, name: str) -> str:
    """Return the two rows of an image; the second lists no keypoints."""
    T_camera_world = T_world_camera.to("cpu").inverse()
    numbers = (*T_camera_world.quaternion("wxyz").tolist(), *T_camera_world.translation.tolist())
    return f"{number} {' '.join(f'{x:.15g}' for x in numbers)} {camera} {name}\n\n"


def camera_row(number: int, camera: Intrinsics) -> str:
    """Return the row of a camera. Raises ``InputError`` for a lens without a COLMAP model."""
    model, parameters = colmap_model(camera)
    numbers = " ".join(f"{x:.15g}" for x in parameters)
    return f"{number} {model} {camera.width} {camera.height} {numbers}\n"


def file_names(images: Sequence[PosedImage]) -> list[str]:
    """Return the paths of the images' files relative to the folder that contains all of them, or the name of
    an image without a file.
    """
    files = [image.file.resolve() for image in images if image.file is not None]
    parent = os.path.commonpath([file.parent for file in files]) if files else ""
    return [
        image.name if image.file is None else Path(os.path.relpath(image.file.resolve(), parent)).as_posix()
        for image in images
    ]


def _check_beside(path: Path) -> None:
    """Raise ``InputError`` if a camera file that this module did not write would be replaced."""
    beside = path.with_name("cameras.txt")
    if beside.exists() and HEAD not in beside.read_text(errors="replace")[:100]:
        raise InputError(
            "would be replaced, since a COLMAP model has one;",
            where=beside,
            expected=f"{path.name} in a folder without another model",
        )
