"""Files of camera intrinsics.

Supported formats are the JSON of NeRF, nerfstudio, Open3D, RealSense and 3D Gaussian Splatting, an answer's and its
``intrinsics``, COLMAP's ``cameras.txt``, hloc's lists of images with cameras, YAML from ROS, OpenCV, ORB-SLAM and Kalibr, ROS's
``ost.txt``, XML from OpenCV and Agisoft, and matrices or ``fx fy cx cy [width height]`` as text, CSV and NumPy's files. Pixel centres
are at +0.5 unless the format follows OpenCV, as matrices, bare numbers, Open3D, RealSense and the YAML files do.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any

import numpy as np

from bidnerf_core.camera.intrinsics import Intrinsics, focal_length, number_array, question_focal
from bidnerf_core.camera.lenses import (
    FISHEYE,
    MODELS,
    PANORAMA,
    PERSPECTIVE,
    Camera,
    CentralLens,
    PanoramaFace,
    colmap_camera,
)
from bidnerf_core.errors import InputError, errors_in
from bidnerf_core.io import (
    Archive,
    Record,
    from_plain,
    parse_json,
    parse_record,
    parse_rows,
    parse_xml,
    parse_yaml,
    read_array,
    read_file,
)

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

KEYS = {
    "K": (
        "camera_matrix",
        "cameraMatrix",
        "Camera_Matrix",
        "camera matrix",
        "intrinsic_matrix",
        "K",
        "k",
        "M1",
        "M",
        "mtx",
    ),
    "coefficients": (
        "distortion_coefficients",
        "Distortion_Coefficients",
        "dist_coeffs",
        "distCoeffs",
        "distortion",
        "D",
        "d",
        "D1",
        "distortion_coeffs",
        "dist",
        "coeffs",
    ),
    "width": ("image_width", "image_Width", "width", "Camera.width", "img_width"),
    "height": ("image_height", "image_Height", "height", "Camera.height", "img_height"),
    "model": ("distortion_model", "Camera.type", "camera_model"),
    "size": ("image_size", "imageSize", "resolution", "size"),
}
"""The keys of calibrations in YAML and JSON, by their meaning."""
DISTORTIONS = {
    FISHEYE: ("equidistant", "fisheye", "kannalabrandt8", "kannala_brandt", "opencv_fisheye"),
    PERSPECTIVE: (
        "plumb_bob",
        "rational_polynomial",
        "radtan",
        "none",
        "pinhole",
        "perspective",
        "opencv",
        "thin_prism",
        "brown_conrady",
        "",
    ),
}
"""The names of distortion models in calibrations, in lower case, by our kind of model."""
CAMERA_FORMATS = (
    "a camera: JSON (fl_x or fx, K, mtx or camera_matrix), YAML of ROS, OpenCV or Kalibr, COLMAP's cameras.txt (from cameras.bin:"
    " model_converter), hloc's list of images, ROS's ost.txt, XML of OpenCV or Agisoft, or a 3x3 matrix or fx fy cx cy"
    " [width height] as text, .npy or .npz"
)
"""The files of cameras that are read, for messages."""
MATRIX_COLUMNS = {9: 3, 12: 4, 16: 4}
"""The columns of a camera's matrix of 3x3, 3x4 or 4x4, by the count of its numbers."""
OWN_KEYS = {"fx", "fy", "cx", "cy", "width", "height", "distortion"}
"""The keys of ``Intrinsics`` as JSON, with pixel centres at +0.5."""
MOST_LINES = 100_000
"""Maximum number of lines of a text file of cameras, which take some seconds to read."""


NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")


def camera_of_record(record: Record, size: tuple[int, int]) -> Camera:
    """Read the camera of a frame or of a whole file; without a size in it, it describes an image of ``size`` (width, height).

    The principal point defaults to the image centre, and a panorama becomes its front face. Raises ``InputError`` for an unknown
    camera model, for a focal length that is missing or not positive, and for implausible values.
    """
    model, width, height = record.text("camera_model") or "", record.size("w") or size[0], record.size("h") or size[1]
    kinds = {name: kind for name, (_, kind, _) in MODELS.items() if name != "FULL_OPENCV"}
    kinds[PERSPECTIVE] = PERSPECTIVE
    kind = kinds.get(model.upper()) if model else PERSPECTIVE
    if kind is None:
        raise record.error(f"camera_model is {model.upper()}", expected=f"one of {', '.join(kinds)}")
    if kind == PERSPECTIVE:  # some programs write 1 for true
        model = FISHEYE if record.value("is_fisheye") else PERSPECTIVE
    model = model.upper()
    if model == PANORAMA:
        with errors_in(record.where):
            return PanoramaFace("front", (width, height))
    fx, fy = _focal(record, "x", width), _focal(record, "y", height)
    if fx is None:
        raise record.error("no focal length", expected="fl_x (pixels) or camera_angle_x (radians)")
    cx, cy = (record.number(key) for key in ("cx", "cy"))
    k1, k2, k3, k4, p1, p2 = (record.number(key) or 0.0 for key in ("k1", "k2", "k3", "k4", "p1", "p2"))
    k1 = k1 if record.number("k1") is not None else record.number("k") or 0.0
    if model == PERSPECTIVE and k4:
        raise record.error("k4 is not 0", expected="no distortion beyond k1 k2 p1 p2 k3")
    lens = (k1, k2, p1, p2, k3) if k3 else (k1, k2, p1, p2) if any((k1, k2, p1, p2)) else ()  # an ideal lens has none
    centre = width / 2 if cx is None else cx, height / 2 if cy is None else cy
    with errors_in(record.where):
        flat = Intrinsics(fx, fx if fy is None else fy, *centre, width, height, lens if model == PERSPECTIVE else ())
        question_focal(flat.fx, width, height)
        if model == PERSPECTIVE:
            return flat
        return CentralLens(model, flat, (k1, k2, k3, k4)[: len(MODELS[model][2]) - 4])


def _focal(record: Record, axis: str, side: int) -> float | None:
    """Return the focal length (pixels) along an axis, on which the image has ``side`` pixels.

    A frame's own value takes precedence over the file's, and a value in pixels over a field of view in radians.
    """
    for scope in record.scopes():
        focal, angle = scope.number(f"fl_{axis}"), scope.number(f"camera_angle_{axis}")
        if focal is not None:
            if focal <= 0:
                raise record.error(f"fl_{axis} is {focal:g}", expected="a positive number of pixels")
            return focal
        if angle is not None:
            if not 0 < angle < math.pi:
                raise record.error(f"camera_angle_{axis} is {angle:g}", expected="radians between 0 and pi")
            return focal_length(side, angle)
    return None


def read_camera(path: Path, size: tuple[int, int], photo: str | None = None) -> Camera:
    """Read the camera from a file in one of the formats that this module supports.

    Files without a size are taken to describe an image of ``size`` (width, height). If a file holds several
    different cameras, the camera of the image named ``photo`` is used. Raises ``InputError`` for other files,
    and if the camera is ambiguous.
    """
    content = read_file(path, CAMERA_FORMATS)
    start = content.lstrip(b"\xef\xbb\xbf \t\r\n")
    if start.startswith(b"\x93NUMPY"):
        return parse_calibration(str(path), {"K": read_array(path, CAMERA_FORMATS).tolist()}, size)
    if start.startswith(b"PK"):
        archive, known = Archive(path, CAMERA_FORMATS), {f"{key}.npy" for keys in KEYS.values() for key in keys}
        arrays = {name: read_array(archive.file(name), CAMERA_FORMATS) for name in archive.names if name in known}
        return parse_calibration(str(path), {name[:-4]: array.tolist() for name, array in arrays.items()}, size)
    if start[:1] == b"[" and start[1:].lstrip()[:1] == b"{":
        return _choose(path, _splat_cameras(path, content), photo)
    if re.match(rb"\[\s*[\[\d.+-]", start):
        return parse_calibration(str(path), {"K": parse_json(content, str(path), CAMERA_FORMATS)}, size)
    if start[:1] in (b"{", b"["):
        return _json_camera(parse_record(str(path), content), size)
    if start.startswith((b"%YAML", b"---")) or path.suffix.lower() in (".yaml", ".yml"):
        return parse_calibration(str(path), parse_yaml(content, str(path), CAMERA_FORMATS), size)
    if start[:1] == b"<":
        return _xml_camera(path, content, size)
    if (lines := content.count(b"\n")) > MOST_LINES:
        raise InputError(f"has {lines:,} lines", where=path, expected=f"a list of at most {MOST_LINES:,} cameras")
    rows = parse_rows(content, path, CAMERA_FORMATS, "CAMERA_ID MODEL WIDTH HEIGHT and parameters")
    words = [word for row in rows[:16] for word in re.split(r"[\s,;]+", row.text.strip(" ,;"))]
    if len(rows) <= 16 and all(map(NUMBER.fullmatch, words)):
        numbers = [float(word) for word in words]
        if len(numbers) in (4, 6) and len(rows) in (1, len(numbers)):
            width, height = numbers[4:] or size
            if not (0 < numbers[2] < width and 0 < numbers[3] < height):
                found = f"cx and cy are {numbers[2]:g} and {numbers[3]:g} for an image of {width:g}x{height:g}"
                raise InputError(found, where=path, expected="fx fy cx cy, or fx fy cx cy width height, in pixels")
            return parse_calibration(str(path), {"K": numbers[:4], "size": [width, height]}, size)
        if len(numbers) in MATRIX_COLUMNS:
            return parse_calibration(str(path), {"K": numbers}, size)
    if any(row.text == "camera matrix" for row in rows):
        sections, title = dict[str, Any](), ""
        for row in rows:
            if all(map(NUMBER.fullmatch, row.words)):
                sections.setdefault(title, []).extend(row.numbers())
            elif (title := row.text) in sections:
                raise row.error(": a second camera; keep the lines of one")
        return parse_calibration(
            str(path), sections | {key: sections.get(key, [0])[0] for key in ("width", "height")}, size
        )
    return _choose(path, _text_cameras(path, content), photo)


def _xml_camera(path: Path, content: bytes, size: tuple[int, int]) -> Camera:
    """Read the XML of OpenCV's ``FileStorage``, or of a lens of Agisoft."""
    root = parse_xml(content, str(path), CAMERA_FORMATS)
    if root.tag == "opencv_storage":
        texts = {node.tag: (node.findtext("data") or node.text or "").split() for node in root}
        return parse_calibration(str(path), {key: t if len(t) > 1 else "".join(t) for key, t in texts.items()}, size)
    sides = [root.findtext(side) or "" for side in ("width", "height")]
    if root.tag != "calibration" or not all(side.isdecimal() and len(side) < 9 for side in sides):
        raise InputError("is no camera", where=path, expected=CAMERA_FORMATS)
    return agisoft_camera(str(path), root.findtext("projection") or "frame", (int(sides[0]), int(sides[1])), root)


def agisoft_camera(where: str, kind: str, size: tuple[int, int], lens: Element) -> Camera:
    """Return the camera of a lens of Agisoft's XML, whose projection is ``kind``.

    ``f`` is in pixels, ``cx cy`` are relative to the image centre, and p1 and p2 are OpenCV's p2 and p1. Raises ``InputError`` for
    a projection or a coefficient that OpenCV's models lack.
    """
    if kind == "spherical":
        return PanoramaFace("front", size)
    values = dict[str, float]()
    for key in ("f", "cx", "cy", "k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4", "b1", "b2"):
        text = (lens.findtext(key) or "0").strip()
        if not NUMBER.fullmatch(text):
            raise InputError(f"{key} is {text[:60]!r}", where=where, expected="a number")
        values[key] = float(text)
    f, cx, cy, k1, k2, k3, k4, p1, p2, *_, b1, _ = values.values()
    is_fisheye = kind in ("fisheye", "equidistant_fisheye")
    unread = next((key for key in ("b2", "p3", "p4", *(("p1", "p2") if is_fisheye else ("k4",))) if values[key]), None)
    if unread or not (is_fisheye or kind == "frame"):
        raise InputError(
            f"{unread} of the lens is {values[unread]:g}" if unread else f"the projection of the lens is {kind}",
            where=where,
            expected="a lens that OpenCV describes; export undistorted images",
        )
    numbers = f + b1, f, size[0] / 2 + cx, size[1] / 2 + cy
    with errors_in(where):
        if is_fisheye:
            return CentralLens(FISHEYE, Intrinsics(*numbers, *size), (k1, k2, k3, k4))
        return Intrinsics(*numbers, *size, (k1, k2, p2, p1, k3) if any((k1, k2, p1, p2, k3)) else ())


def _json_camera(record: Record, size: tuple[int, int]) -> Camera:
    values = record.values
    views = values.get("parameters")
    if isinstance(views, list) and views and isinstance(views[0], Mapping):  # Open3D's trajectory
        named = {f"view {number}": parse_calibration(record.where, view, size) for number, view in enumerate(views)}
        return _choose(Path(record.where), named, None)
    for key in ("intrinsics", "camera", "color", "colour", "rgb"):  # of an answer, Replica, RealSense
        if isinstance(inner := values.get(key), Mapping) and "fl_x" not in values:
            return _json_camera(Record(f"{record.where}: {key}", inner), size)
    if values.keys() == OWN_KEYS:
        with errors_in(record.where):
            return from_plain(Intrinsics, values, record.where)
    if "fx" in values:
        names = (("fx",), ("fy",), ("cx", "ppx"), ("cy", "ppy"))
        fx, fy, cx, cy = (next((record.number(key) for key in each if key in values), None) for each in names)
        if fx is None or cx is None or cy is None:
            raise record.error(
                "has fx but no cx and cy", expected="fx, fy, cx, cy (pixels), and perhaps width and height"
            )
        values = {**values, "K": [fx, 0, cx, 0, fx if fy is None else fy, cy, 0, 0, 1], "w": None}
        values |= {"distortion_model": str(values.get("model", "")).rpartition(".")[2]}
    if any(values.get(key) for key in ("intrinsics", "intrinsic", *KEYS["K"])):
        return parse_calibration(record.where, values, size)
    if not any(key in values for key in ("camera_model", "fl_x", "camera_angle_x")):
        raise record.error("no focal length", expected=CAMERA_FORMATS)
    return camera_of_record(record, size)


def _splat_cameras(path: Path, content: bytes) -> dict[str, Camera]:
    """Read 3D Gaussian Splatting's ``cameras.json``: a list of cameras with image names."""
    entries = parse_json(content, str(path), "a camera, or a list of cameras")
    cameras: dict[str, Camera] = {}
    for number, entry in enumerate(entries):
        record = Record(f"{path}: entry {number}", entry if isinstance(entry, Mapping) else {})
        fx, fy, width, height = (
            record.checked_number(record.value(key), key) for key in ("fx", "fy", "width", "height")
        )
        K = ((fx, 0, width / 2 - 0.5), (0, fy, height / 2 - 0.5), (0, 0, 1))
        name = str(record.value("img_name") or number)
        cameras[name] = _opencv_camera(record.where, K, (), "", (int(width), int(height)))
    return cameras


def _choose(path: Path, cameras: Mapping[str, Camera], photo: str | None) -> Camera:
    """Return the only camera, or the one that matches a photo's path, file name or stem."""
    if len(set(cameras.values())) == 1:
        return next(iter(cameras.values()))
    wanted = None if photo is None else PurePosixPath(photo.replace("\\", "/"))
    for part in () if wanted is None else (str, lambda p: p.name, lambda p: p.stem):
        fits = {c for name, c in cameras.items() if part(PurePosixPath(name)) == part(wanted)}
        if len(fits) == 1:
            return fits.pop()
    raise InputError(
        f"holds {len(cameras)} cameras",
        where=path,
        expected="exactly one, or one named after the photo; keep only this photo's line",
    )


def read_text_cameras(path: Path) -> dict[int, Camera]:
    """Read the cameras in COLMAP's ``cameras.txt``, by id. Raises ``InputError`` if the file is malformed."""
    content = read_file(path, "COLMAP's cameras.txt")
    return {int(key): camera for key, camera in _text_cameras(path, content, named=False).items()}


def _text_cameras(path: Path, content: bytes, named: bool = True) -> dict[str, Camera]:
    """Parse rows of ``CAMERA_ID MODEL WIDTH HEIGHT PARAMS...``, or hloc's rows with an image name instead of the id."""
    cameras: dict[str, Camera] = {}
    for row in parse_rows(content, path, CAMERA_FORMATS, "CAMERA_ID MODEL WIDTH HEIGHT and parameters"):
        words = row.words
        if len(words) < 5:
            raise InputError(f"line {row.line} has {len(words)} entries", where=path, expected=CAMERA_FORMATS)
        if words[1] not in MODELS:
            raise InputError(f"camera model {words[1]}", where=row.where, expected=f"one of {', '.join(MODELS)}")
        key = words[0] if named and not words[0].lstrip("-").isdecimal() else str(row.integer(words[0]))
        size = row.integer(words[2]), row.integer(words[3])
        camera = colmap_camera(row.where, words[1], *size, row.numbers(words[4:]))
        if cameras.setdefault(key, camera) != camera:
            raise InputError(f"camera {key} is repeated", where=row.where, expected="each id once")
    return cameras


def parse_calibration(where: str, values: Mapping[str, Any], size: tuple[int, int]) -> Camera:
    """Parse the camera in a mapping written by a calibration tool or a robot.

    Without an image size in it, ``size`` (width, height) is assumed. Raises ``InputError``, whose message begins with
    ``where``, if the mapping does not describe a single camera.
    """
    inner = [value for key, value in values.items() if re.fullmatch(r"cam\d+", str(key))]  # in Kalibr
    if len(inner) > 1:
        raise InputError(
            f"holds {len(inner)} cameras", where=where, expected="one; keep only the lines of this photo's camera"
        )
    for inside in (*inner, values.get("intrinsic")):  # Open3D nests the camera of a view
        values = inside if isinstance(inside, Mapping) else values
    if inner and (kind := values.get("camera_model", "pinhole")) != "pinhole":
        raise InputError(f"camera_model is {kind}", where=where, expected="pinhole")
    given, four, lens = _first(values, "K"), values.get("intrinsics"), _first(values, "coefficients")
    model = str(next((values[key] for key in KEYS["model"] if key in values), ""))
    if slam := next((name for name in ("Camera", "Camera1") if f"{name}.fx" in values), None):
        names = ("k1", "k2", "k3", "k4") if model.lower() in DISTORTIONS[FISHEYE] else ("k1", "k2", "p1", "p2", "k3")
        four, lens = ([values.get(f"{slam}.{x}", 0.0) for x in some] for some in (("fx", "fy", "cx", "cy"), names))
    if given is None and four is None:
        raise InputError(f"no camera matrix ({', '.join(KEYS['K'][:3])} or K)", where=where, expected=CAMERA_FORMATS)
    K = _camera_matrix(_array(where, four if given is None else given))
    pair = _first(values, "size") or [_first(values, key) or 0 for key in ("width", "height")]
    sides = _array(where, pair).ravel().astype(int).tolist()
    if len(sides) != 2:
        raise InputError(f"size is {str(pair)[:60]!r}", where=where, expected="width and height in pixels")
    lens = tuple(_array(where, lens or []).ravel().tolist())
    return _opencv_camera(where, K, lens, model, (sides[0], sides[1]) if min(sides) > 0 else size)


def _camera_matrix(numbers: np.ndarray) -> np.ndarray:
    """Return the 3x3 matrix of fx, fy, cx and cy, or of a larger matrix in rows or, as ARKit and Open3D write it, in columns."""
    if numbers.size == 4:
        fx, fy, cx, cy = numbers.ravel()
        return np.array(((fx, 0, cx), (0, fy, cy), (0, 0, 1)))
    if numbers.size not in MATRIX_COLUMNS:
        return numbers
    K = numbers.reshape(-1, MATRIX_COLUMNS[numbers.size])[:3, :3]
    return K.T if K[2, :2].any() and not K[:2, 2].any() else K


def _opencv_camera(where: str, K: Any, lens: tuple[float, ...], model: str, size: tuple[int, int]) -> Camera:
    """Return the camera of a matrix and coefficients, as ``Intrinsics.from_opencv`` does, or a fisheye lens."""
    kind = next((kind for kind, names in DISTORTIONS.items() if model.lower() in names), None)
    if kind is None and "brown_conrady" in model.lower() and not any(lens):  # RealSense's own, without distortion
        kind = PERSPECTIVE
    if kind is None:
        raise InputError(
            f"distortion model {model}", where=where, expected="plumb_bob, rational_polynomial or equidistant"
        )
    with errors_in(where):
        if kind == PERSPECTIVE:
            return Intrinsics.from_opencv(K, lens or None, size)
        return CentralLens(FISHEYE, Intrinsics.from_opencv(K, None, size), (*lens, 0.0, 0.0, 0.0, 0.0)[:4])


def _first(values: Mapping[str, Any], what: str) -> Any:
    nothing = (None, "", "~", "null")  # YAML is read as text
    return next((values[key] for key in KEYS[what] if values.get(key) not in nothing), None)


def _array(where: str, given: Any) -> np.ndarray:
    """Convert a list, or the ``data`` of an OpenCV or ROS matrix, to an array of finite numbers; YAML reads 1e-05 as text."""
    with errors_in(where):
        return number_array("an entry", given.get("data") if isinstance(given, Mapping) else given)
