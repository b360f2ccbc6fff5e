"""COLMAP text models: ``images.txt``, with ``cameras.txt`` and ``points3D.txt`` next to it.

See https://colmap.github.io/format.html. COLMAP's poses are world to camera, quaternions have the scalar
first, and pixel centres are at +0.5, as in this package.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from bidnerf.results.pose_files import PosedImage, frame_of, pose_format
from bidnerf_core.camera import Intrinsics, colmap_model
from bidnerf_core.errors import InputError, printable
from bidnerf_core.io import write_file

HEAD = "# written by bidnerf"


def check_pose_file(path: Path) -> None:
    """Check that a pose file may be written under this name, before any work is done.

    Raises ``UsageError`` for a name without the ending of a known format, and ``InputError`` for an
    images.txt next to another program's cameras.txt or points3D.txt, which would be overwritten.
    """
    if pose_format(path) != "images.txt":
        return
    for beside in (path.with_name("cameras.txt"), path.with_name("points3D.txt")):
        if beside.exists() and HEAD not in beside.read_text(errors="replace")[:100]:
            expected = f"{path.name} in a folder without another model"
            raise InputError("would be replaced, since a COLMAP model has one;", where=beside, expected=expected)


def write_colmap_poses(path: Path, images: Sequence[PosedImage]) -> None:
    """A COLMAP model: images.txt, and cameras.txt and points3D.txt beside it.

    Image names are file paths relative to the folder that contains all of the images. Raises ``InputError`` for
    a lens that COLMAP cannot describe, and as ``check_pose_file`` does.
    """
    check_pose_file(path)
    files = [image.file for image in images if image.file is not None]
    folder = os.path.commonpath([file.resolve().parent for file in files]) if files else ""
    stored = list[PosedImage]()
    for image in images:
        name = image.name
        if image.file is not None:
            name = Path(os.path.relpath(image.file.resolve(), folder)).as_posix()
        stored.append(replace(image.as_stored, name=name))
    write_colmap_model(path, stored)


def write_colmap_model(
    path: Path,
    images: Sequence[PosedImage],
    points: Sequence[str] = (),
    keypoints: Sequence[Sequence[str]] = (),
) -> None:
    """Write a COLMAP text model; image names, poses and cameras must already be those of the stored files.

    ``points`` holds the rows of points3D.txt, and ``keypoints`` the POINTS2D[] entries of each image: x, y, and
    the number of the point. Characters in names that would break a row are escaped.
    """
    cameras, listed = dict[Intrinsics, int](), ""
    rows = list[str]()
    for number, image in enumerate(images, start=1):
        T = image.pose.inverse()
        numbers = (*T.quaternion("wxyz").tolist(), *T.translation.tolist())
        own = cameras.setdefault(image.intrinsics, len(cameras) + 1)
        pose = " ".join(f"{x:.15g}" for x in numbers)
        seen = " ".join(keypoints[number - 1]) if keypoints else ""
        rows.append(f"{number} {pose} {own} {printable(image.name)}\n{seen}\n")
    head = f"{HEAD}; {frame_of(images, 'world to camera')}\n"
    for camera, number in cameras.items():
        model, parameters = colmap_model(camera)
        lens = " ".join(f"{x:.15g}" for x in parameters)
        listed += f"{number} {model} {camera.width} {camera.height} {lens}\n"
    columns = {
        "cameras.txt": "# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n" + listed,
        "points3D.txt": "# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)\n"
        + "".join(f"{row}\n" for row in points),
        path.name: "# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME, then POINTS2D[] as (X, Y, POINT3D_ID)\n"
        + "".join(rows),
    }
    for name, content in columns.items():
        write_file(path.with_name(name), f"{head}{content}".encode())
