"""Rendered sequences of Replica as iMAP and NICE-SLAM distribute them (https://github.com/cvg/nice-slam).

``results/frame000000.jpg`` and ``results/depth000000.png`` (16-bit planar z) are the frames; ``traj.txt``
has a row of sixteen numbers for each, the 4x4 camera-to-world matrix (OpenCV axes, metres). The camera and
the steps of depth per metre (``scale``) are in ``cam_params.json`` of the folder or the one above; without
this file, the published values apply. Principal points are relative to the centre of the upper left pixel,
so half a pixel is added.
"""

from __future__ import annotations

from pathlib import Path

from bidnerf.formats.layouts import Layout
from bidnerf_core.camera import Intrinsics
from bidnerf_core.datasets import Capture, DatasetOptions, Format, camera_of, first_file, pose_of_matrix
from bidnerf_core.errors import InputError
from bidnerf_core.io import Record, read_record, read_rows

CAMERA_KEYS = ("fx", "fy", "cx", "cy", "scale")


REPLICA = Layout(
    (("results",),), image=r"(frame[^.]*)\..+", pose=("../traj.txt",), depth=("depth{number}.png",), unmeasured=()
)


def _read(path: Path, images: list[Path], options: DatasetOptions) -> Capture:
    """Read the trajectory. Raises ``InputError`` if it is invalid or shorter than the sequence."""
    trajectory = path / "traj.txt"
    rows = read_rows(trajectory, "Replica's trajectory", "16 numbers, a 4x4 matrix")
    if len(rows) < len(images):
        raise InputError(f"has {len(rows)} rows for {len(images)} frames", where=trajectory, expected="one for each")
    poses = [pose_of_matrix(row.where, row.numbers(count=16)) for row in rows[: len(images)]]
    file = first_file(path, "cam_params.json", f"{path.resolve().parent}/cam_params.json")
    camera, step = (Intrinsics(600, 600, 600, 340, 1200, 680), 1 / 6553.5) if file is None else _camera(file)
    unit = options.depth_unit or step
    shots = REPLICA.shots(images, camera, unit, poses={i.stem: T for i, T in zip(images, poses, strict=True)})
    return Capture(path, shots, options.colour, "metres", depth_unit=unit, pose_file=trajectory)


def _camera(file: Path) -> tuple[Intrinsics, float]:
    """Return the camera, and the metres per step of depth. Raises ``InputError`` if one of them is missing."""
    record = read_record(file)
    inner = record.value("camera")
    own = Record(f"{file}: camera", inner) if isinstance(inner, dict) else record
    numbers, width, height = [own.number(key) or 0.0 for key in CAMERA_KEYS], own.size("w"), own.size("h")
    if not all(numbers) or width is None or height is None or numbers[4] < 0:
        raise own.error("is incomplete", expected=f"w, h, {', '.join(CAMERA_KEYS)}")
    return camera_of(own.where, numbers[:4], (width, height)), 1 / numbers[4]


reader = Format(
    "Replica of iMAP and NICE-SLAM: depth in the steps of cam_params.json",
    "traj.txt with results/frame000000.jpg (Replica)",
    REPLICA.images,
    _read,
    ["depth_unit"],
    may_lack_poses=True,
    precedence=30,  # a recording with metric poses
)
