"""Files of camera intrinsics.

Supported formats are the JSON of NeRF, nerfstudio, Open3D and 3D Gaussian Splatting, COLMAP's
``cameras.txt``, hloc's lists of images with cameras, and the YAML that ``calibrations`` reads. Pixel centres
are at +0.5 unless the format follows OpenCV.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from bidnerf_core.camera.calibrations import (
    calibrated_camera,
    gaussian_splatting_camera,
    read_yaml_camera,
)
from bidnerf_core.camera.colmap_models import MODELS, colmap_camera
from bidnerf_core.camera.intrinsics import Intrinsics, focal_length, question_focal
from bidnerf_core.camera.lenses import (
    LENS_MODELS,
    PANORAMA,
    Camera,
    CentralLens,
    PanoramaFace,
)
from bidnerf_core.errors import InputError
from bidnerf_core.io import Record, Row, parse_json, parse_record, parse_rows, read_file

PERSPECTIVE_MODELS = ("PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "RADIAL", "SIMPLE_RADIAL", "PERSPECTIVE")
FISHEYE_KEYS = ("k1", "k2", "k3", "k4")
DISTORTION_KEYS = ("k1", "k2", "p1", "p2", "k3")


@dataclass(frozen=True)
class CameraRecord:
    """Intrinsics before the image size is known; each axis has a focal length (pixels) or a field of view
    (radians).
    """

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
    lens: str | None = None  # the model of a non-perspective lens; its coefficients are ``distortion``
    face: str | None = None  # of a panorama

    def intrinsics(self, width: int, height: int) -> Camera:
        """Return the camera for an image of this size; the principal point defaults to the image centre.

        Raises ``InputError`` for implausible values.
        """
        try:
            if self.lens == PANORAMA:
                return PanoramaFace(self.face or "front", width, height)
            return self._central(width, height)
        except InputError as error:
            raise self.record.error(error) from error

    def _central(self, width: int, height: int) -> Camera:
        fx = self.focal_x if self.angle_x is None else focal_length(width, self.angle_x)
        fy = self.focal_y if self.angle_y is None else focal_length(height, self.angle_y)
        assert fx is not None  # ensured by camera_record
        cx = width / 2 if self.cx is None else self.cx
        cy = height / 2 if self.cy is None else self.cy
        fy = fx if fy is None else fy
        lens = self.distortion if self.lens is None else ()
        flat = Intrinsics(fx, fy, cx, cy, width, height, lens)
        question_focal(fx, width, height)
        if self.lens is None:
            return flat
        model, places = LENS_MODELS[self.lens]
        return CentralLens(
            model, fx, fy, cx, cy, width, height, self.distortion[: len(places) - 4], self.lens
        )


def camera_record(record: Record) -> CameraRecord:
    """Read the intrinsics of a frame or of a whole file.

    Raises ``InputError`` for an unknown camera model and for a focal length that is missing or not positive.
    """
    lens = _lens(record)
    width, height = record.size("w"), record.size("h")
    if lens == PANORAMA:
        return CameraRecord(record, width, height, None, None, None, None, None, None, (), lens)
    focal_x, angle_x = _focal(record, "x")
    focal_y, angle_y = _focal(record, "y")
    if focal_x is None and angle_x is None:
        raise record.error("no focal length", expected="fl_x (pixels) or camera_angle_x (radians)")
    return CameraRecord(
        record,
        width,
        height,
        focal_x,
        focal_y,
        angle_x,
        angle_y,
        record.number("cx"),
        record.number("cy"),
        _distortion(record) if lens is None else _coefficients(record),
        lens,
    )


def _lens(record: Record) -> str | None:
    """Return the name of a non-perspective model (from ``LENS_MODELS``, or ``PANORAMA``); None for
    perspective ones.
    """
    model = (record.text("camera_model") or "").upper()
    if record.value("is_fisheye") and model in ("", *PERSPECTIVE_MODELS):  # some programs write 1 for true
        return "OPENCV_FISHEYE"
    if model in (*LENS_MODELS, PANORAMA):
        return model
    if model and model not in PERSPECTIVE_MODELS:
        expected = ", ".join((*PERSPECTIVE_MODELS, *LENS_MODELS, PANORAMA))
        raise record.error(f"camera_model is {model}", expected=f"one of {expected}")
    return None


def _coefficients(record: Record) -> tuple[float, ...]:
    """Return the coefficients of a fisheye or division lens; a single one may be called k."""
    first, *rest = (record.number(key) for key in FISHEYE_KEYS)
    if first is None:
        first = record.number("k")
    return tuple(value or 0.0 for value in (first, *rest))


def _focal(record: Record, axis: str) -> tuple[float | None, float | None]:
    """Return the focal length or angle of an axis. A frame's own value takes precedence over the file's, and
    pixels over radians.
    """
    for scope in record.scopes():
        focal, angle = scope.number(f"fl_{axis}"), scope.number(f"camera_angle_{axis}")
        if focal is not None:
            if focal <= 0:
                raise record.error(f"fl_{axis} is {focal:g}", expected="a positive number of pixels")
            return focal, None
        if angle is not None:
            if not 0 < angle < math.pi:
                raise record.error(f"camera_angle_{axis} is {angle:g}", expected="radians between 0 and pi")
            return None, angle
    return None, None


def _distortion(record: Record) -> tuple[float, ...]:
    """Return the coefficients in OpenCV's order; an ideal lens has none."""
    if record.number("k4"):
        raise record.error("k4 is not 0", expected="no distortion beyond k1 k2 p1 p2 k3")
    values = tuple(record.number(key) or 0.0 for key in DISTORTION_KEYS)
    if not any(values):
        return ()
    return values if values[4] else values[:4]


def read_camera(path: Path, size: tuple[int, int], photo: str | None = None) -> Camera:
    """Read the camera from a file in one of the formats above.

    Files without a size are taken to describe an image of ``size`` (width, height). If a file holds several
    different cameras, the one of the image named ``photo`` is used. Raises ``InputError`` for other files,
    and if the camera is ambiguous.
    """
    content = read_file(path, "a camera file (JSON, YAML, COLMAP's cameras.txt or a list of images)")
    start = content.lstrip(b"\xef\xbb\xbf \t\r\n")
    if start[:1] == b"{":
        return _json_camera(parse_record(str(path), content), size)
    if start[:1] == b"[" and start[1:].lstrip()[:1] == b"{":
        return _chosen(path, _splat_cameras(path, content), photo)
    if start[:1] == b"[":
        return _json_camera(parse_record(str(path), content), size)
    if start.startswith((b"%YAML", b"---")) or path.suffix.lower() in (".yaml", ".yml"):
        return read_yaml_camera(str(path), content, size)
    return _chosen(path, _text_cameras(path, content), photo)


def _json_camera(record: Record, size: tuple[int, int]) -> Camera:
    values = record.values
    views = values.get("parameters")
    if isinstance(views, list) and views and isinstance(views[0], Mapping):  # Open3D's trajectory
        found = {calibrated_camera(record.where, view, size) for view in views}
        if len(found) > 1:
            raise record.error(f"holds {len(found)} cameras", expected="one")
        return found.pop()
    if any(key in values for key in ("intrinsic_matrix", "intrinsic", "camera_matrix", "K")):
        return calibrated_camera(record.where, values, size)
    camera = camera_record(record)
    return camera.intrinsics(camera.width or size[0], camera.height or size[1])


def _splat_cameras(path: Path, content: bytes) -> dict[str, Camera]:
    """Read 3D Gaussian Splatting's ``cameras.json``: a list of cameras with image names."""
    entries = parse_json(content, str(path), "a camera, or a list of cameras")
    found: dict[str, Camera] = {}
    for number, entry in enumerate(entries):
        if not isinstance(entry, Mapping):
            raise InputError(
                f"entry {number} is not a camera", where=path, expected="img_name, width, height, fx and fy"
            )
        found[str(entry.get("img_name", number))] = gaussian_splatting_camera(
            f"{path}: entry {number}", entry
        )
    return found


def _chosen(path: Path, cameras: Mapping[str, Camera], photo: str | None) -> Camera:
    """Return the only camera, or the one that matches a photo's path, file name or stem."""
    if len(set(cameras.values())) == 1:
        return next(iter(cameras.values()))
    asked = None if photo is None else PurePosixPath(photo.replace("\\", "/"))
    for part in () if asked is None else (str, lambda p: p.name, lambda p: p.stem):
        fits = {c for name, c in cameras.items() if part(PurePosixPath(name)) == part(asked)}
        if len(fits) == 1:
            return fits.pop()
    raise InputError(
        f"holds {len(cameras)} cameras",
        where=path,
        expected="exactly one, or one named after the photo; keep only this photo's line",
    )


def read_text_cameras(path: Path) -> dict[int, Camera]:
    """Read COLMAP's ``cameras.txt`` and return its cameras by id. Raises ``InputError``."""
    content = read_file(path, "COLMAP's cameras.txt")
    return {int(key): camera for key, camera in _text_cameras(path, content, named=False).items()}


def _text_cameras(path: Path, content: bytes, named: bool = True) -> dict[str, Camera]:
    """Parse rows of ``CAMERA_ID MODEL WIDTH HEIGHT PARAMS...``, or hloc's rows with an image name instead of
    the id.
    """
    expected = "transforms.json or cameras.txt (COLMAP's model_converter makes it from cameras.bin)"
    found: dict[str, Camera] = {}
    for row in parse_rows(content, path, expected, "CAMERA_ID MODEL WIDTH HEIGHT and parameters"):
        key, camera = _text_camera(row, named)
        if found.setdefault(key, camera) != camera:
            raise InputError(f"camera {key} is repeated", where=row.where, expected="each id once")
    return found


def _text_camera(row: Row, named: bool) -> tuple[str, Camera]:
    words = row.words
    if len(words) < 5:
        raise row.error(f" has {len(words)} entries")
    if words[1] not in MODELS:
        raise InputError(f"camera model {words[1]}", where=row.where, expected=f"one of {', '.join(MODELS)}")
    width, height = (row.integer(words[place]) for place in (2, 3))
    key = words[0] if named and not words[0].lstrip("-").isdecimal() else str(row.integer(words[0]))
    return key, colmap_camera(row.where, words[1], width, height, row.numbers(words[4:]))
