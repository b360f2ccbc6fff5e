"""Wavefront OBJ, read by trimesh, with its material file and textures."""

from __future__ import annotations

import io
from pathlib import Path

from bidnerf_core.datasets import warn_about
from bidnerf_core.errors import InputError
from bidnerf_core.io import is_file, open_binary
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
    folder, lines = path.parent, _arguments(path, "mtllib")

    def exists(name: str) -> bool:
        """Return whether a file exists below the folder; no other is opened."""
        return is_file(folder / name) and (folder / name).resolve().is_relative_to(folder.resolve())

    materials = [name for line in lines for name in ([line] if exists(line) else line.split())]
    textures = [line for name in materials if exists(name) for line in _arguments(folder / name, "map_kd")]
    names = [*materials, *(line.split()[-1] if line.startswith("-") else line for line in textures)]
    missing = [f"{name}, its material or texture, is missing" for name in names if not exists(name)]
    # trimesh takes the whole line for one name.
    unread = [
        f"{line!r}, several materials or a texture with options, is not supported"
        for line in (*lines, *textures)
        if not exists(line)
    ]
    if unread:
        warn_about(path, f"{[*missing, *unread][0]}, so it is read without colours")
    return by_trimesh.read(path, EXPECTED, has_materials=not unread)


def _arguments(path: Path, keyword: str) -> list[str]:
    """Return what follows a ``keyword``, in capitals or not, in each line that begins with it."""
    with open_binary(path, EXPECTED) as file, io.TextIOWrapper(file, "utf-8-sig", "replace") as text:
        rows = (line.split(maxsplit=1) for line in text)
        return [row[1].strip() for row in rows if len(row) == 2 and row[0].lower() == keyword]
