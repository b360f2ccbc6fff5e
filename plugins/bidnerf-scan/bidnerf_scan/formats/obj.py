"""Wavefront OBJ, read by trimesh, with its material file and textures."""

from __future__ import annotations

from pathlib import Path

from bidnerf_core.errors import InputError
from bidnerf_scan.formats import by_trimesh
from bidnerf_scan.scan import Scan

EXPECTED = "an OBJ file of a mesh or of points"


def recognises(path: Path) -> bool:
    """Return whether the file has the extension of an OBJ file, whose text has no signature."""
    return path.suffix.lower() == ".obj"


def read(path: Path) -> Scan:
    """Return the mesh or the points of an OBJ file."""
    if path.stat().st_size == 0:
        raise InputError("is empty", where=path, expected=EXPECTED)
    return by_trimesh.read(path, EXPECTED)
