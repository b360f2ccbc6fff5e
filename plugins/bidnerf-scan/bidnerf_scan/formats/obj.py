"""Wavefront OBJ, by trimesh, with the material file and the textures beside it."""

from __future__ import annotations

from pathlib import Path

from bidnerf_core.errors import InputError
from bidnerf_scan.formats import by_trimesh
from bidnerf_scan.scan import Scan

EXPECTED = "an OBJ file of a mesh or of points"


def recognises(path: Path) -> bool:
    """Return whether the file's name is that of an OBJ file: its text has no mark."""
    return path.suffix.lower() == ".obj"


def read(path: Path) -> Scan:
    """Return the mesh or the points of an OBJ file."""
    if path.stat().st_size == 0:
        raise InputError(f"{path}: is empty, expected {EXPECTED}")
    return by_trimesh.read(path, EXPECTED)
