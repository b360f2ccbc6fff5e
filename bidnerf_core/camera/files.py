"""Files of intrinsics: the JSON of NeRF and nerfstudio, and COLMAP's ``cameras.txt``; pixel centres are at +0.5 like ours."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from bidnerf_core.camera.intrinsics import Intrinsics, focal_length
from bidnerf_core.errors import InputError
from bidnerf_core.io.files import read_file
from bidnerf_core.io.json import Record, parse_record
from bidnerf_core.io.rows import Row, parse_rows

PERSPECTIVE_MODELS = ("PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "RADIAL", "SIMPLE_RADIAL")
DISTORTION_KEYS = ("k1", "k2", "p1", "p2", "k3")
COLMAP_MODELS: dict[str, tuple[int, ...]] = {
    # Indices of fx, fy, cx, cy and the distortion (in OpenCV's order) among the parameters; -1 is a coefficient of 0.
    "SIMPLE_PINHOLE": (0, 0, 1, 2),
    "PINHOLE": (0, 1, 2, 3),
    "SIMPLE_RADIAL": (0, 0, 1, 2, 3, -1, -1, -1),
    "RADIAL": (0, 0, 1, 2, 3, 4, -1, -1),
    "OPENCV": (0, 1, 2, 3, 4, 5, 6, 7),
    "FULL_OPENCV": (0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11),
}
"""Parameters of COLMAP's perspective models (https://colmap.github.io/cameras.html). Its pixel centres are at +0.5 as well."""
COLMAP_MODEL_IDS = {
    0: "SIMPLE_PINHOLE",
    1: "PINHOLE",
    2: "SIMPLE_RADIAL",
    3: "RADIAL",
    4: "OPENCV",
    6: "FULL_OPENCV",
}
"""The ids of these models in ``cameras.bin``."""


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


def read_camera(path: Path, size: tuple[int, int]) -> Intrinsics:
    """Read the camera in the header of a ``transforms.json`` or ``cameras.json``, or in COLMAP's ``cameras.txt``.

    JSON without ``w`` and ``h`` describes an image of ``size`` (width, height). Raises ``InputError`` for other files, for
    lenses that are not perspective, and where ``cameras.txt`` holds several different cameras.
    """
    content = read_file(path, "a JSON file or COLMAP's cameras.txt")
    if content.lstrip(b"\xef\xbb\xbf \t\r\n")[:1] in (b"{", b"["):
        record = camera_record(parse_record(str(path), content))
        return record.intrinsics(record.width or size[0], record.height or size[1])
    cameras = _colmap_cameras(path, content)
    if len(set(cameras.values())) != 1:
        raise InputError(f"{path}: holds {len(cameras)} cameras, expected one; keep the line of this photo's")
    return next(iter(cameras.values()))


def read_text_cameras(path: Path) -> dict[int, Intrinsics]:
    """Read COLMAP's ``cameras.txt`` and return its cameras by their ids. Raises ``InputError``."""
    return _colmap_cameras(path, read_file(path, "COLMAP's cameras.txt"))


def _colmap_cameras(path: Path, content: bytes) -> dict[int, Intrinsics]:
    expected = "transforms.json or cameras.txt (COLMAP's model_converter makes it of cameras.bin)"
    found: dict[int, Intrinsics] = {}
    for row in parse_rows(content, path, expected, "CAMERA_ID MODEL WIDTH HEIGHT and parameters"):
        key, camera = _text_camera(row)
        if found.setdefault(key, camera) != camera:
            raise InputError(f"{row.where}: camera {key} again, expected each id once")
    return found


def _text_camera(row: Row) -> tuple[int, Intrinsics]:
    """Read ``CAMERA_ID MODEL WIDTH HEIGHT PARAMS...``."""
    words = row.words
    if len(words) < 5:
        raise row.error(f" has {len(words)} entries")
    if words[1] not in COLMAP_MODELS:
        raise InputError(f"{row.where}: camera model {words[1]}, expected one of {', '.join(COLMAP_MODELS)}")
    number, width, height = (row.integer(words[place]) for place in (0, 2, 3))
    return number, colmap_camera(row.where, words[1], width, height, row.numbers(words[4:]))


def colmap_parameters(model: str) -> int:
    """Return the number of parameters of one of ``COLMAP_MODELS``."""
    return max(COLMAP_MODELS[model]) + 1


def colmap_camera(where: str, model: str, width: int, height: int, parameters: Sequence[float]) -> Intrinsics:
    """Return a camera of one of ``COLMAP_MODELS``. Raises ``InputError``, whose message begins with ``where``."""
    if len(parameters) != colmap_parameters(model):
        raise InputError(
            f"{where}: {model} has {len(parameters)} parameters, expected {colmap_parameters(model)}"
        )
    fx, fy, cx, cy, *lens = (0.0 if place < 0 else parameters[place] for place in COLMAP_MODELS[model])
    try:
        return Intrinsics(fx, fy, cx, cy, width, height, tuple(lens) if any(lens) else ())
    except InputError as error:
        raise InputError(f"{where}: {error}") from error
