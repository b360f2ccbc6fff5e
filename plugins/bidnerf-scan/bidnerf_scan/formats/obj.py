"""Wavefront OBJ, read by trimesh, with its material file and textures."""

from __future__ import annotations

from pathlib import Path

from bidnerf_core.datasets import warn_about
from bidnerf_core.errors import InputError
from bidnerf_core.io import is_file, read_file
from bidnerf_scan.formats import by_trimesh
from bidnerf_scan.scan import Scan

EXPECTED = "an OBJ file of a mesh or of points"


def recognises(path: Path) -> bool:
    """Return whether the file has the extension of an OBJ file, whose text has no signature."""
    return path.suffix.lower() == ".obj"


def read(path: Path) -> Scan:
    """Return the mesh or the points of an OBJ file; without its material file or a texture, it has no colours but those of vertices."""
    if path.stat().st_size == 0:
        raise InputError("is empty", where=path, expected=EXPECTED)
    folder, materials = path.parent, _named(path, "mtllib")

    def exists(name: str) -> bool:
        """Return whether a file exists below the folder; no other is opened."""
        return is_file(folder / name) and (folder / name).resolve().is_relative_to(folder.resolve())

    textures = [name for file in materials if exists(file) for name in _named(folder / file, "map_Kd")]
    missing = [name for name in (*materials, *textures) if not exists(name)]
    if missing:
        warn_about(path, f"{missing[0]}, its material or texture, is missing, so it is read without colours")
    return by_trimesh.read(path, EXPECTED, has_materials=not missing)


def _named(path: Path, keyword: str) -> list[str]:
    """Return the names of files after a ``keyword`` at the beginning of a line; options precede the name of a texture."""
    lines = read_file(path, EXPECTED).decode("utf-8", "replace").splitlines()
    names = [line.removeprefix(keyword).strip() for line in lines if line.startswith(f"{keyword} ")]
    return [name.split()[-1] if name.startswith("-") else name for name in names if name]
