"""Folders with a table of poses, as many small robots write them: ``poses.csv``, ``camera.json`` and images.

A row of ``poses.csv`` has the name of an image, its time in seconds, and the twelve numbers of the row-major
3 x 4 matrix ``T_world_camera`` (metres, x right, y down, z forward). Images are ``NAME.png`` with depth in
``NAME.depth.png`` (16 bits, millimetres, 0: not measured).
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch

from bidnerf_core.camera import CameraSource
from bidnerf_core.datasets import Capture, DatasetOptions, DepthFile, Reader, Shot
from bidnerf_core.depth import read_depth_image
from bidnerf_core.errors import InputError
from bidnerf_core.geometry import SE3

TABLE, CAMERA = "poses.csv", "camera.json"


@dataclass(frozen=True)
class Row:
    """A row of the table."""

    name: str
    time: float
    T_world_camera: SE3


class PoseTableReader(Reader):
    """The object that the entry point names."""

    expected = f"{TABLE} and {CAMERA} next to images"

    def recognises(self, path: Path) -> bool:
        return (path / TABLE).is_file() and (path / CAMERA).is_file()

    def read(self, path: Path, options: DatasetOptions) -> Capture:
        shots = []
        for row in read_table(path / TABLE):
            depth = path / f"{row.name}.depth.png"
            shots.append(
                Shot(
                    image=path / f"{row.name}.png",
                    camera=CameraSource(path / CAMERA),
                    T_world_camera=row.T_world_camera,
                    time=row.time,
                    depth=DepthFile(depth, partial(read_depth_image, depth, 0.001)),
                    splits=("train",),
                )
            )
        return Capture(path, shots, options.colour)


reader = PoseTableReader()


def read_table(file: Path) -> list[Row]:
    """Read the rows of ``poses.csv``. Raises ``InputError``, which names the line, for an invalid one."""
    found = []
    with file.open(newline="", encoding="utf-8") as opened:
        for number, cells in enumerate(csv.reader(opened), 1):
            try:
                name, *values = cells
                time, *matrix = map(float, values)
                rows = torch.tensor(matrix, dtype=torch.float64).reshape(3, 4)
            except (ValueError, RuntimeError) as error:
                raise InputError(f"line {number} is not a name and 13 numbers", where=file) from error
            pose = SE3(rows[:, :3], rows[:, 3])
            if not bool(pose.is_rigid()):
                raise InputError(f"line {number}: the pose of {name} is not a rigid transform", where=file)
            found.append(Row(name, time, pose.normalized()))
    return found
