"""COLMAP's Python package, which only structure from motion needs, and its cameras."""

from __future__ import annotations

from typing import Any

from bidnerf_core.camera import Intrinsics, colmap_camera, colmap_model
from bidnerf_core.errors import InputError


def pycolmap_for(what: str) -> Any:
    """Import pycolmap, silenced. Raises ``InputError``, whose message begins with ``what``, if it is not installed."""
    try:
        import pycolmap
    except ImportError as error:
        raise InputError(
            "finding the poses of photos needs the extra 'sfm' (pip install 'bidnerf[sfm]')", where=what
        ) from error
    if not hasattr(pycolmap, "CancellationToken"):  # a name that exists from 4.2 on
        raise InputError(
            f"pycolmap is {pycolmap.__version__}",
            where=what,
            expected="4.2 or later (pip install -U 'bidnerf[sfm]')",
        )
    pycolmap.logging.minloglevel = pycolmap.logging.Level.FATAL.value
    return pycolmap


def to_colmap(intrinsics: Intrinsics, number: int, pycolmap: Any) -> Any:
    """Convert to a pycolmap camera, whose pixel coordinates follow the same convention as ``Intrinsics``.

    Raises ``InputError`` for a lens without a COLMAP model.
    """
    model, parameters = colmap_model(intrinsics)
    return pycolmap.Camera(
        camera_id=number, model=model, width=intrinsics.width, height=intrinsics.height, params=parameters
    )


def from_colmap(camera: Any) -> Intrinsics:
    """Return the intrinsics of a pycolmap camera with a perspective lens."""
    found = colmap_camera("COLMAP", camera.model.name, camera.width, camera.height, list(camera.params))
    if not isinstance(found, Intrinsics):
        raise InputError(
            f"camera model {camera.model.name}", where="COLMAP", expected="one of a perspective lens"
        )
    return found
