"""COLMAP's Python package, which only structure from motion needs, and its cameras."""

from __future__ import annotations

from typing import Any

from bidnerf_core.camera.colmap_models import colmap_camera, colmap_model
from bidnerf_core.camera.intrinsics import Intrinsics
from bidnerf_core.errors import InputError

NEWEST_NEEDED = "CancellationToken"
"""A name that pycolmap has from version 4.2 on, which is the oldest that serves."""


def pycolmap_for(what: str) -> Any:
    """Return the module pycolmap, silenced. Raises ``InputError``, which begins with ``what``, where it is not installed."""
    try:
        import pycolmap
    except ImportError as error:
        raise InputError(
            f"{what}: finding the poses of photos needs the extra 'sfm' (pip install 'bidnerf[sfm]')"
        ) from error
    if not hasattr(pycolmap, NEWEST_NEEDED):
        raise InputError(
            f"{what}: pycolmap is {pycolmap.__version__}, expected 4.2 or later (pip install -U 'bidnerf[sfm]')"
        )
    pycolmap.logging.minloglevel = pycolmap.logging.Level.FATAL.value
    return pycolmap


def to_colmap(intrinsics: Intrinsics, number: int, pycolmap: Any) -> Any:
    """Return a camera for pycolmap, whose pixel coordinates follow the same convention as ``Intrinsics``.

    Raises ``InputError`` for a lens that COLMAP has no model of.
    """
    model, parameters = colmap_model(intrinsics)
    return pycolmap.Camera(
        camera_id=number, model=model, width=intrinsics.width, height=intrinsics.height, params=parameters
    )


def from_colmap(camera: Any) -> Intrinsics:
    """Return the intrinsics of one of pycolmap's cameras with a perspective lens."""
    found = colmap_camera("COLMAP", camera.model.name, camera.width, camera.height, list(camera.params))
    if not isinstance(found, Intrinsics):
        raise InputError(f"COLMAP: camera model {camera.model.name}, expected one of a perspective lens")
    return found
