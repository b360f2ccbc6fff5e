"""Cameras as NeRF's and nerfstudio's JSON describe them, in our conventions.

Poses come as camera-to-world matrices with OpenGL axes (x right, y up, z backward); they leave as ``T_world_camera`` with
OpenCV axes. Intrinsics are for pixel centres at +0.5, as ours are.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from bidnerf_core.camera import Intrinsics
from bidnerf_core.datasets.records import Record
from bidnerf_core.se3 import SE3

PERSPECTIVE_MODELS = ("PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "RADIAL", "SIMPLE_RADIAL")
DISTORTION_KEYS = ("k1", "k2", "p1", "p2", "k3")
RIGID_TO = 5e-3
"""Largest entry of R^T R - 1 that passes for rounding (matrices printed with three decimals reach 2e-3)."""


@dataclass(frozen=True)
class CameraRecord:
    """Intrinsics before the image's size is known: of each axis a focal length (pixels) or a field of view (radians)."""

    record: Record
    width: int | None
    height: int | None
    focal_x: float | None
    focal_y: float | None
    angle_x: float | None
    angle_y: float | None
    cx: float | None
    cy: float | None
    distortion: tuple[float, ...]

    def intrinsics(self, width: int, height: int) -> Intrinsics:
        """For an image of this size; without a principal point of its own the camera looks through the middle."""
        fx = self.focal_x if self.angle_x is None else _focal_length(width, self.angle_x)
        fy = self.focal_y if self.angle_y is None else _focal_length(height, self.angle_y)
        assert fx is not None  # camera_record saw to it
        cx = width / 2 if self.cx is None else self.cx
        cy = height / 2 if self.cy is None else self.cy
        return Intrinsics(fx, fx if fy is None else fy, cx, cy, width, height, self.distortion)


def camera_record(record: Record) -> CameraRecord:
    """Read the intrinsics of one frame. Raises ``InputError`` for a model that is not perspective or a bad focal length."""
    _check_model(record)
    focal_x, angle_x = _focal(record, "x")
    focal_y, angle_y = _focal(record, "y")
    if focal_x is None and angle_x is None:
        raise record.error("no focal length, expected fl_x (pixels) or camera_angle_x (radians)")
    return CameraRecord(
        record,
        record.size("w"),
        record.size("h"),
        focal_x,
        focal_y,
        angle_x,
        angle_y,
        record.number("cx"),
        record.number("cy"),
        _distortion(record),
    )


def pose(record: Record) -> SE3:
    """``T_world_camera`` (OpenCV axes, float64) from ``transform_matrix`` (3x4 or 4x4, OpenGL axes).

    A rotation that is orthonormal but for rounding is made so. Raises ``InputError`` for one that is not.
    """
    matrix = _matrix(record)
    flip = matrix.new_tensor(
        [1.0, -1.0, -1.0]
    )  # of columns: y up becomes y down, z backward becomes z forward
    given = SE3(matrix[:3, :3] * flip, matrix[:3, 3])
    if not given.is_rigid(RIGID_TO):
        off = (given.rotation.mT @ given.rotation - torch.eye(3, dtype=torch.float64)).abs().max().item()
        finding = f"off orthonormal by {off:.2g}" if off > RIGID_TO else "a mirror image"
        raise record.error(f"the rotation of transform_matrix is {finding}, expected a rigid transform")
    return given.normalized()


def _matrix(record: Record) -> Tensor:
    """Three or four rows of four finite numbers, the fourth row being 0 0 0 1."""
    rows = record.items("transform_matrix")
    if rows is None:
        raise record.error("no transform_matrix, expected a 4x4 camera-to-world matrix")
    if len(rows) not in (3, 4) or not all(isinstance(row, list) and len(row) == 4 for row in rows):
        raise record.error("transform_matrix is not 3x4 or 4x4, expected a 4x4 camera-to-world matrix")
    numbers = [[record.checked_number(x, "a number of transform_matrix") for x in row] for row in rows]
    if len(numbers) == 4 and max(abs(x - y) for x, y in zip(numbers[3], (0, 0, 0, 1), strict=True)) > 1e-6:
        raise record.error(f"the last row of transform_matrix is {numbers[3]}, expected [0, 0, 0, 1]")
    return torch.tensor(numbers[:3], dtype=torch.float64)


def _check_model(record: Record) -> None:
    model = record.text("camera_model")
    if record.value("is_fisheye") is True:
        model = "fisheye (is_fisheye)"
    if model is not None and model.upper() not in PERSPECTIVE_MODELS:
        raise record.error(f"camera_model is {model}, expected one of {', '.join(PERSPECTIVE_MODELS)}")


def _focal(record: Record, axis: str) -> tuple[float | None, float | None]:
    """Focal length or angle of an axis: a frame's own before the file's, pixels before radians."""
    for scope in record.scopes():
        focal, angle = scope.number(f"fl_{axis}"), scope.number(f"camera_angle_{axis}")
        if focal is not None:
            if focal <= 0:
                raise record.error(f"fl_{axis} is {focal:g}, expected a positive number of pixels")
            return focal, None
        if angle is not None:
            if not 0 < angle < math.pi:
                raise record.error(f"camera_angle_{axis} is {angle:g}, expected radians between 0 and pi")
            return None, angle
    return None, None


def _distortion(record: Record) -> tuple[float, ...]:
    """As OpenCV orders it, empty where the lens is ideal."""
    if record.number("k4"):
        raise record.error("k4 is not 0, expected no distortion beyond k1 k2 p1 p2 k3")
    values = tuple(record.number(key) or 0.0 for key in DISTORTION_KEYS)
    if not any(values):
        return ()
    return values if values[4] else values[:4]


def _focal_length(pixels: int, angle: float) -> float:
    """Half the image over the tangent of half its field of view."""
    return pixels / 2 / math.tan(angle / 2)
