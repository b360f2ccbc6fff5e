"""Intrinsics as in NeRF's and nerfstudio's JSON, for which pixel centres are at +0.5 like ours."""

from __future__ import annotations

import math
from dataclasses import dataclass

from bidnerf_core.camera.intrinsics import Intrinsics, focal_length
from bidnerf_core.errors import InputError
from bidnerf_core.io.json import Record

PERSPECTIVE_MODELS = ("PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "RADIAL", "SIMPLE_RADIAL")
DISTORTION_KEYS = ("k1", "k2", "p1", "p2", "k3")


@dataclass(frozen=True)
class CameraRecord:
    """Intrinsics before the image's size is known; each axis has a focal length (pixels) or a field of view (radians)."""

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
        """Return the camera of an image of this size; a principal point that is not given is in the middle.

        Raises ``InputError`` for numbers that no camera has.
        """
        fx = self.focal_x if self.angle_x is None else focal_length(width, self.angle_x)
        fy = self.focal_y if self.angle_y is None else focal_length(height, self.angle_y)
        assert fx is not None  # camera_record ensures it
        cx = width / 2 if self.cx is None else self.cx
        cy = height / 2 if self.cy is None else self.cy
        try:
            return Intrinsics(fx, fx if fy is None else fy, cx, cy, width, height, self.distortion)
        except InputError as error:
            raise self.record.error(str(error)) from error


def camera_record(record: Record) -> CameraRecord:
    """Read the intrinsics of a frame or of a whole file.

    Raises ``InputError`` for a camera model that is not perspective and for a focal length that is missing or not positive.
    """
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


def _check_model(record: Record) -> None:
    model = record.text("camera_model")
    if record.value("is_fisheye"):  # some programs write 1 for true
        model = "fisheye (is_fisheye)"
    if model is not None and model.upper() not in PERSPECTIVE_MODELS:
        raise record.error(f"camera_model is {model}, expected one of {', '.join(PERSPECTIVE_MODELS)}")


def _focal(record: Record, axis: str) -> tuple[float | None, float | None]:
    """Return the focal length or the angle of an axis. A frame's own precedes the file's, and pixels precede radians."""
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
    """Return the coefficients in OpenCV's order; an ideal lens has none."""
    if record.number("k4"):
        raise record.error("k4 is not 0, expected no distortion beyond k1 k2 p1 p2 k3")
    values = tuple(record.number(key) or 0.0 for key in DISTORTION_KEYS)
    if not any(values):
        return ()
    return values if values[4] else values[:4]
