"""COLMAP's camera models (https://colmap.github.io/cameras.html). Its pixel centres are at +0.5, like ours."""

from __future__ import annotations

from collections.abc import Sequence

from bidnerf_core.camera.intrinsics import Intrinsics
from bidnerf_core.camera.lenses import LENS_MODEL_IDS, LENS_MODELS, PANORAMA, Camera, lens_camera
from bidnerf_core.errors import InputError

COLMAP_MODELS: dict[str, tuple[int, ...]] = {
    # Indices of fx, fy, cx, cy and the distortion (in OpenCV's order) among the parameters; -1 means a
    # coefficient of 0.
    "SIMPLE_PINHOLE": (0, 0, 1, 2),
    "PINHOLE": (0, 1, 2, 3),
    "SIMPLE_RADIAL": (0, 0, 1, 2, 3, -1, -1, -1),
    "RADIAL": (0, 0, 1, 2, 3, 4, -1, -1),
    "OPENCV": (0, 1, 2, 3, 4, 5, 6, 7),
    "FULL_OPENCV": (0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11),
}
"""Parameters of the perspective models."""
COLMAP_MODEL_IDS = {
    0: "SIMPLE_PINHOLE",
    1: "PINHOLE",
    2: "SIMPLE_RADIAL",
    3: "RADIAL",
    4: "OPENCV",
    6: "FULL_OPENCV",
}
"""The ids of these models in ``cameras.bin``."""
MODELS = (*COLMAP_MODELS, *LENS_MODELS, PANORAMA)
"""The names of all supported models."""
MODEL_IDS = COLMAP_MODEL_IDS | LENS_MODEL_IDS
"""The model names by their ids in ``cameras.bin``."""
MOST_TERMS = 8
"""Number of distortion coefficients in COLMAP's largest perspective model, in OpenCV's order."""


def colmap_parameters(model: str) -> int:
    """Return the number of parameters of one of ``MODELS``."""
    if model == PANORAMA:
        return 2
    return max(COLMAP_MODELS[model] if model in COLMAP_MODELS else LENS_MODELS[model][1]) + 1


def colmap_camera(where: str, model: str, width: int, height: int, parameters: Sequence[float]) -> Camera:
    """Build a camera from its COLMAP model (one of ``MODELS``), its size (pixels) and its parameters in COLMAP's order.

    Raises ``InputError`` if the number of parameters is wrong or a value is invalid; the message begins with ``where``.
    """
    if len(parameters) != colmap_parameters(model):
        raise InputError(
            f"{model} has {len(parameters)} parameters", where=where, expected=colmap_parameters(model)
        )
    if model not in COLMAP_MODELS:
        return lens_camera(where, model, width, height, parameters)
    fx, fy, cx, cy, *lens = (0.0 if place < 0 else parameters[place] for place in COLMAP_MODELS[model])
    try:
        return Intrinsics(fx, fy, cx, cy, width, height, tuple(lens) if any(lens) else ())
    except InputError as error:
        raise InputError(error, where=where) from error


def colmap_model(camera: Intrinsics) -> tuple[str, list[float]]:
    """Return the name and parameters of the simplest COLMAP model that describes a camera.

    Raises ``InputError`` for thin prism distortion or a tilted sensor, which no COLMAP model has.
    """
    k = camera.distortion
    if any(k[MOST_TERMS:]):
        raise InputError(
            "a camera with thin prism distortion or a tilted sensor",
            expected="one that a COLMAP model describes",
        )
    model, count = (
        ("PINHOLE", 0) if not any(k) else ("OPENCV", 4) if not any(k[4:]) else ("FULL_OPENCV", MOST_TERMS)
    )
    lens = [*k, *[0.0] * MOST_TERMS][:count]
    return model, [camera.fx, camera.fy, camera.cx, camera.cy, *lens]
