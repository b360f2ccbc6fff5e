"""Rendered sequences of Replica as iMAP and NICE-SLAM distribute them (https://github.com/cvg/nice-slam).

``results/frame000000.jpg`` and ``results/depth000000.png`` (16-bit planar z) are the frames; ``traj.txt``
has a row of sixteen numbers for each, the 4x4 camera-to-world matrix (OpenCV axes, metres). The camera and
the steps of depth per metre (``scale``) are in ``cam_params.json`` of the folder or the one above; without
this file, the published values apply. Principal points are relative to the centre of the upper left pixel,
so half a pixel is added.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

from bidnerf_core.camera import Intrinsics
from bidnerf_core.datasets import (
    Capture,
    DatasetOptions,
    DepthFile,
    Format,
    Shot,
    camera_of,
    first_file,
    pose_of_matrix,
)
from bidnerf_core.depth import DepthReader
from bidnerf_core.errors import InputError
from bidnerf_core.frames import natural_order
from bidnerf_core.io import Record, is_file, read_record, read_rows

CAMERA_KEYS = ("fx", "fy", "cx", "cy", "scale")


def _read(path: Path, images: list[Path], options: DatasetOptions) -> Capture:
    """Read the trajectory. Raises ``InputError`` if it is invalid or shorter than the sequence."""
    trajectory = path / "traj.txt"
    rows = read_rows(trajectory, "Replica's trajectory", "16 numbers, a 4x4 matrix")
    if len(rows) < len(images):
        found = f"has {len(rows)} rows for {len(images)} frames"
        raise InputError(found, where=trajectory, expected="one for each")
    camera, step = _camera(path)
    unit, read, shots = options.depth_unit or step, DepthReader(), list[Shot]()
    for row, image in zip(rows, images, strict=False):
        depth = image.with_name(f"{image.stem.replace('frame', 'depth')}.png")
        shots.append(
            Shot(
                image=image,
                camera=camera,
                T_world_camera=pose_of_matrix(row.where, row.numbers(count=16)),
                depth=DepthFile(depth, partial(read, depth, unit)) if is_file(depth) else None,
            )
        )
    return Capture(path, shots, options.colour, unit="metres", depth_unit=unit, pose_file=trajectory)


def _find(path: Path) -> list[Path]:
    """Return the images of a posed sequence, in order."""
    found = (path / "results").glob("frame*") if is_file(path / "traj.txt") else ()
    return sorted(found, key=lambda file: natural_order(file.name))


def _camera(path: Path) -> tuple[Intrinsics, float]:
    """Return the camera, and the metres per step of depth."""
    file = first_file(path, "cam_params.json", f"{path.resolve().parent}/cam_params.json")
    if file is None:
        return Intrinsics(600.0, 600.0, 600.0, 340.0, 1200, 680), 1 / 6553.5
    record = read_record(file)
    camera = record.value("camera")
    own = record if not isinstance(camera, dict) else Record(f"{file}: camera", camera)
    numbers, width, height = [own.number(key) or 0.0 for key in CAMERA_KEYS], own.size("w"), own.size("h")
    if not all(numbers) or width is None or height is None or numbers[4] < 0:
        raise own.error("is incomplete", expected=f"w, h, {', '.join(CAMERA_KEYS)}")
    return camera_of(own.where, numbers[:4], (width, height)), 1 / numbers[4]


reader = Format(
    "Replica of iMAP and NICE-SLAM: depth in the steps of cam_params.json",
    "traj.txt with results/frame000000.jpg (Replica)",
    _find,
    _read,
    ["depth_unit"],
    may_lack_poses=True,
    precedence=30,  # a recording with metric poses
)
