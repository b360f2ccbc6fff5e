"""Cameras in the files of calibration tools and robots: YAML from ROS, OpenCV, ORB-SLAM and Kalibr, and JSON
from Open3D.

All of them follow OpenCV: the centre of the first pixel is (0, 0), so half a pixel is added to principal
points.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import numpy as np
import yaml

from bidnerf_core.camera.intrinsics import Intrinsics, question_focal
from bidnerf_core.camera.lenses import Camera, lens_camera
from bidnerf_core.errors import InputError

MATRICES = ("camera_matrix", "cameraMatrix", "Camera_Matrix", "intrinsic_matrix", "K", "k", "M1", "M")
COEFFICIENTS = (
    "distortion_coefficients", "Distortion_Coefficients", "dist_coeffs", "distCoeffs", "distortion", "D", "d", "D1",
)  # fmt: skip
WIDTHS = ("image_width", "image_Width", "width", "Camera.width", "img_width")
HEIGHTS = ("image_height", "image_Height", "height", "Camera.height", "img_height")
SIZES = ("image_size", "imageSize", "resolution", "size")
FISHEYES = ("equidistant", "fisheye", "kannalabrandt8", "kannala_brandt", "opencv_fisheye")
PERSPECTIVE = (
    "plumb_bob", "rational_polynomial", "radtan", "none", "pinhole", "perspective", "opencv", "thin_prism", "",
)  # fmt: skip
EXPECTED = "YAML from ROS (camera_info), OpenCV, ORB-SLAM or Kalibr with the intrinsics of one camera"


class _Loader(yaml.SafeLoader):
    """YAML loader for plain values, with OpenCV's matrices as mappings."""


_Loader.add_multi_constructor("", lambda loader, suffix, node: _plain(loader, node))
_Loader.add_multi_constructor("tag:yaml.org,2002:opencv", lambda loader, suffix, node: _plain(loader, node))


def _plain(loader: yaml.SafeLoader, node: yaml.Node) -> Any:
    if isinstance(node, yaml.MappingNode):
        return loader.construct_mapping(node, deep=True)
    if isinstance(node, yaml.SequenceNode):
        return loader.construct_sequence(node, deep=True)
    return loader.construct_scalar(node)


def read_yaml_camera(where: str, content: bytes, size: tuple[int, int]) -> Camera:
    """Parse the camera in a YAML file. If the file gives no image size, ``size`` (width, height) is assumed.

    Raises ``InputError``, whose message begins with ``where``.
    """
    try:
        text = re.sub(r"\A\s*%YAML.*\n", "", content.decode("utf-8-sig"))
        values = next(iter(yaml.load_all(text, Loader=_Loader)), None)
    except (UnicodeDecodeError, yaml.YAMLError, ValueError, RecursionError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"is not YAML ({reason})", where=where, expected=EXPECTED) from error
    if not isinstance(values, Mapping):
        raise InputError(where=where, expected=EXPECTED)
    return calibrated_camera(where, values, size)


def calibrated_camera(where: str, values: Mapping[str, Any], size: tuple[int, int]) -> Camera:
    """Parse the camera in an object written by one of these tools. Raises ``InputError``, whose message
    begins with ``where``.
    """
    inner = [value for key, value in values.items() if re.fullmatch(r"cam\d+", str(key))]
    if len(inner) > 1:
        raise InputError(
            f"holds {len(inner)} cameras",
            where=where,
            expected="one; keep only the lines of this photo's camera",
        )
    if inner and isinstance(inner[0], Mapping):
        return _kalibr(where, inner[0], size)
    if isinstance(values.get("intrinsic"), Mapping):  # a view in Open3D
        return calibrated_camera(where, values["intrinsic"], size)
    flat = _orb_slam(where, values)
    if flat is not None:
        matrix, coefficients, model = flat
    else:
        given = _first(values, MATRICES)
        if given is None:
            raise InputError(
                f"no camera matrix ({', '.join(MATRICES[:3])} or K)", where=where, expected=EXPECTED
            )
        by_columns = "intrinsic_matrix" in values and not isinstance(given, Mapping)
        matrix, coefficients = _array(where, given), _array(where, _first(values, COEFFICIENTS) or [])
        matrix = matrix.reshape(3, 3).T if by_columns and matrix.ndim == 1 and matrix.size == 9 else matrix
        model = str(values.get("distortion_model", values.get("camera_model", "")))
    return _camera(where, matrix, coefficients.ravel(), model, _size(where, values, size))


def _kalibr(where: str, values: Mapping[str, Any], size: tuple[int, int]) -> Camera:
    four, kind = _array(where, values.get("intrinsics", [])), str(values.get("camera_model", "pinhole"))
    if kind != "pinhole" or four.size != 4:
        raise InputError(
            f"camera_model is {kind} with {four.size} intrinsics", where=where, expected="pinhole with 4"
        )
    fx, fy, cx, cy = four.ravel().tolist()
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    coefficients = _array(where, values.get("distortion_coeffs", []))
    model = str(values.get("distortion_model", "none"))
    return _camera(where, matrix, coefficients.ravel(), model, _size(where, values, size))


def _orb_slam(where: str, values: Mapping[str, Any]) -> tuple[np.ndarray, np.ndarray, str] | None:
    name = next((n for n in ("Camera", "Camera1") if f"{n}.fx" in values), None)
    if name is None:
        return None
    numbers = {
        key: float(_array(where, values.get(f"{name}.{key}", 0.0)))
        for key in ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4")
    }
    fx, fy, cx, cy, k1, k2, p1, p2, k3, k4 = numbers.values()
    model = str(values.get("Camera.type", "pinhole"))
    lens = [k1, k2, k3, k4] if model.lower() in FISHEYES else [k1, k2, p1, p2, k3]
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), np.array(lens), model


def _camera(
    where: str, matrix: np.ndarray, coefficients: np.ndarray, model: str, size: tuple[int, int]
) -> Camera:
    kind = model.lower()
    if kind not in (*FISHEYES, *PERSPECTIVE):
        raise InputError(
            f"distortion model {model}", where=where, expected="plumb_bob, rational_polynomial or equidistant"
        )
    try:
        if kind not in FISHEYES or not matrix.size:
            return Intrinsics.from_opencv(matrix, coefficients if len(coefficients) else None, size)
        flat = Intrinsics.from_opencv(matrix, None, size)
    except InputError as error:
        raise InputError(error, where=where) from error
    lens = [*coefficients.tolist(), 0.0, 0.0, 0.0, 0.0][:4]
    return lens_camera(where, "OPENCV_FISHEYE", *size, [flat.fx, flat.fy, flat.cx, flat.cy, *lens])


def gaussian_splatting_camera(where: str, values: Mapping[str, Any]) -> Intrinsics:
    """Parse one camera of 3D Gaussian Splatting's ``cameras.json``, whose principal point is the image
    centre.
    """
    numbers = [float(_array(where, values.get(key, "none"))) for key in ("fx", "fy", "width", "height")]
    fx, fy, width, height = numbers
    try:
        question_focal(fx, int(width), int(height))
        return Intrinsics(fx, fy, width / 2, height / 2, int(width), int(height))
    except InputError as error:
        raise InputError(error, where=where) from error


def _first(values: Mapping[str, Any], keys: tuple[str, ...]) -> Any:
    return next((values[key] for key in keys if values.get(key) is not None), None)


def _array(where: str, given: Any) -> np.ndarray:
    """Return a list, or the data of an OpenCV or ROS matrix."""
    found = given.get("data") if isinstance(given, Mapping) else given
    try:
        return np.asarray(found, dtype=float)  # YAML reads 1e-05 as text
    except (TypeError, ValueError) as error:
        raise InputError(f"{str(given)[:60]!r}", where=where, expected="numbers") from error


def _size(where: str, values: Mapping[str, Any], size: tuple[int, int]) -> tuple[int, int]:
    pair = _first(values, SIZES)
    found = _array(
        where, pair if pair is not None else [_first(values, keys) or 0 for keys in (WIDTHS, HEIGHTS)]
    )
    if found.size != 2 or not np.isfinite(found).all():
        raise InputError(f"size is {str(pair)[:60]!r}", where=where, expected="width and height in pixels")
    width, height = (int(value) for value in found.ravel())
    return (width, height) if width > 0 and height > 0 else size
