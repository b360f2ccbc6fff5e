"""Scans of ScanNet (http://www.scan-net.org), as its ``SensReader`` exports them.

``color/0.jpg`` is an image, ``depth/0.png`` its depth (16-bit planar z in millimetres, of the depth
camera), and ``pose/0.txt`` its pose (4x4, camera to world, OpenCV axes, metres; -inf if tracking failed).
``intrinsic/intrinsic_color.txt`` and ``intrinsic_depth.txt`` are the 4x4 matrices of the two cameras, whose
principal points are relative to the centre of the upper left pixel, so half a pixel is added. Depth is
registered to the colour camera using these intrinsics, as in 12-Scenes.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

from bidnerf.formats.twelve_scenes import own_sensor
from bidnerf_core.camera import Intrinsics
from bidnerf_core.datasets import (
    Capture,
    DatasetOptions,
    DepthFile,
    Format,
    Shot,
    camera_of,
    first_file,
    read_pose_matrix,
)
from bidnerf_core.depth import MILLIMETRE, DepthReader
from bidnerf_core.errors import InputError
from bidnerf_core.frames import photos_in
from bidnerf_core.io import read_header, read_rows


def _read(path: Path, match: tuple[list[Path], Path], options: DatasetOptions) -> Capture:
    """Read the cameras and poses. Raises ``InputError`` if one is invalid."""
    images, intrinsics = match
    depth = _intrinsics(path, "depth")
    measured = {file.stem: file for file in photos_in(path / "depth")[0]} if (path / "depth").is_dir() else {}
    camera = read_matrix(intrinsics, _size(images[0]))
    own = None if depth is None or not measured else read_matrix(depth, _size(next(iter(measured.values()))))
    sensor, unit = options.sensor(path, own_sensor(camera, own)), options.depth_unit or MILLIMETRE
    read, shots = DepthReader(documented=("65535",)), list[Shot]()
    for image in images:
        pose, file = path / "pose" / f"{image.stem}.txt", measured.get(image.stem)
        shots.append(
            Shot(
                image=image,
                camera=camera,
                T_world_camera=read_pose_matrix(pose),
                depth=None if file is None else DepthFile(file, partial(read, file, unit), sensor),
            )
        )
    return Capture(
        path,
        shots,
        options.colour,
        unit="metres",
        depth_unit=unit,
        pose_file=path / "pose",
        poses_expected="NUMBER.txt of finite numbers for each image",
    )


def _find(path: Path) -> tuple[list[Path], Path] | None:
    """Return the images and the file of their intrinsics, or None if something is missing."""
    folders = (folder for name in ("color", "rgb") if (folder := path / name).is_dir())
    images = next((photos for folder in folders if (photos := photos_in(folder)[0])), None)
    intrinsics = _intrinsics(path, "color")
    return (images, intrinsics) if images and intrinsics and (path / "pose").is_dir() else None


def _intrinsics(path: Path, kind: str) -> Path | None:
    name = f"intrinsic_{kind}.txt"
    return first_file(path, f"intrinsic/{name}", name, f"intrinsics/{name}")


def _size(image: Path) -> tuple[int, int]:
    header = read_header(image)
    return header.width, header.height


def read_matrix(file: Path, size: tuple[int, int], first_centre: float = 0.5) -> Intrinsics:
    """Return the camera of images of a ``size`` from a matrix (3x3 or 4x4), or from a focal length, with or without a centre."""
    expected = "a matrix of intrinsics, 3x3 or 4x4"
    rows = [row.numbers() for row in read_rows(file, "intrinsics", expected)]
    if rows and len(rows[0]) == 1:
        return camera_of(file, (*rows[0], *rows[0], size[0] / 2, size[1] / 2), size, first_centre=0)
    if rows and rows[0][1:2] != [0.0] and len(rows[0]) in (3, 4):  # NSVF's focal length and centre
        rows = [[rows[0][0], 0, rows[0][1]], [0, rows[0][0], rows[0][2]], [0, 0, 1]]
    if len(rows) < 3 or any(len(row) < 3 for row in rows):
        raise InputError(f"has {len(rows)} rows", where=file, expected=expected)
    (fx, _, cx, *_), (_, fy, cy, *_) = rows[:2]
    return camera_of(file, (fx, fy, cx, cy), size, first_centre=first_centre)


reader = Format(
    "exported ScanNet: depth in millimetres, registered to the colour camera",
    "color/0.jpg with pose/0.txt and intrinsic/intrinsic_color.txt (ScanNet)",
    _find,
    _read,
    ("register_depth", "depth_unit"),
    may_lack_poses=True,
    precedence=30,  # a recording with metric poses
)
