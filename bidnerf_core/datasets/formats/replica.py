"""Rendered sequences of Replica as iMAP and NICE-SLAM distribute them (https://github.com/cvg/nice-slam).

``results/frame000000.jpg`` and ``results/depth000000.png`` (16-bit planar z) are the frames; ``traj.txt`` has a row of sixteen
numbers for each, the 4x4 camera-to-world matrix (OpenCV axes, metres). The camera and the steps of depth per metre (``scale``) are
in ``cam_params.json`` of the folder or the one above; without it, the published ones apply. Principal points are relative to the
centre of the upper left pixel, so half a pixel is added. Every eighth frame (the first, the ninth ...) is held out as "test" and
the others are "train".
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import torch

from bidnerf_core.camera import Intrinsics
from bidnerf_core.datasets.capture import Capture, DepthFile, Shot
from bidnerf_core.datasets.reader import DatasetOptions, OpenQuestion, Reader
from bidnerf_core.depth import DepthReader
from bidnerf_core.errors import InputError
from bidnerf_core.frames import natural_order
from bidnerf_core.geometry import rigid_pose
from bidnerf_core.io import Record, is_file, read_record, read_rows

TRAJECTORY, PARAMETERS = "traj.txt", "cam_params.json"
CAMERA = Intrinsics(600.0, 600.0, 600.0, 340.0, 1200, 680)
METRES_PER_STEP = 1 / 6553.5
KEYS = ("fx", "fy", "cx", "cy", "scale")


class ReplicaReader(Reader):
    """Reader for rendered sequences of Replica."""

    accepts: tuple[OpenQuestion, ...] = ("depth_unit",)
    expected = f"{TRAJECTORY} with results/frame000000.jpg (Replica)"

    def recognises(self, path: Path) -> bool:
        return is_file(path / TRAJECTORY) and any((path / "results").glob("frame*"))

    def read(self, path: Path, options: DatasetOptions) -> Capture:
        """Read the trajectory. Raises ``InputError`` if it is invalid or shorter than the sequence."""
        images = sorted((path / "results").glob("frame*"), key=lambda file: natural_order(file.name))
        rows = read_rows(path / TRAJECTORY, "Replica's trajectory", "16 numbers, a 4x4 matrix")
        if len(rows) < len(images):
            found = f"has {len(rows)} rows for {len(images)} frames"
            raise InputError(found, where=path / TRAJECTORY, expected="one for each")
        camera, step = _camera(path)
        unit, read, shots = options.depth_unit or step, DepthReader(), list[Shot]()
        for row, image in zip(rows, images, strict=False):
            matrix = torch.tensor(row.numbers(count=16), dtype=torch.float64).reshape(4, 4)
            depth = image.with_name(f"{image.stem.replace('frame', 'depth')}.png")
            shots.append(
                Shot(
                    image=image,
                    camera=camera,
                    T_world_camera=rigid_pose(matrix[:3], row.where),
                    depth=DepthFile(depth, partial(read, depth, unit)) if is_file(depth) else None,
                )
            )
        return Capture(
            path, shots, options.colour, unit="metres", depth_unit=unit, pose_file=path / TRAJECTORY
        )


def _camera(path: Path) -> tuple[Intrinsics, float]:
    """Return the camera, and the metres per step of depth."""
    file = next(
        (file for place in (path, path.resolve().parent) if is_file(file := place / PARAMETERS)), None
    )
    if file is None:
        return CAMERA, METRES_PER_STEP
    record = read_record(file)
    camera = record.value("camera")
    own = record if not isinstance(camera, dict) else Record(f"{file}: camera", camera)
    numbers, width, height = [own.number(key) for key in KEYS], own.size("w"), own.size("h")
    fx, fy, cx, cy, scale = (number or 0.0 for number in numbers)
    if None in numbers or width is None or height is None or scale <= 0:
        raise own.error("is incomplete", expected=f"w, h, {', '.join(KEYS)}")
    try:
        return Intrinsics(fx, fy, cx + 0.5, cy + 0.5, width, height), 1 / scale
    except InputError as error:
        raise own.error(error) from error


reader = ReplicaReader()
