"""Files of meshes and point clouds, identified by their names and first bytes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from bidnerf_core.errors import InputError
from bidnerf_scan.formats import gltf, obj, pcd, ply, survey
from bidnerf_scan.scan import Scan


@dataclass(frozen=True)
class Format:
    """A kind of file."""

    name: str
    up: str  # upward axis by its convention
    convention: str  # how binding this is
    recognises: Callable[[Path], bool]
    read: Callable[[Path], Scan]


FORMATS = (
    Format("PLY", "+z", "as in most scans; PLY specifies none", ply.recognises, ply.read),
    Format("OBJ", "+y", "as written by most programs; OBJ specifies none", obj.recognises, obj.read),
    Format("glTF", "+y", "as glTF prescribes", gltf.recognises, gltf.read),
    Format("PCD", "+z", "as in most scans; PCD specifies none", pcd.recognises, pcd.read),
    Format("LAS", "+z", "as LAS prescribes", survey.recognises_las, survey.read_las),
    Format("E57", "+z", "as E57 prescribes, in metres", survey.recognises_e57, survey.read_e57),
)
"""All formats, at most one of which recognizes a file."""


def format_of(path: Path) -> Format | None:
    """Return the format of a file, or None if it has none of these."""
    if not path.is_file():
        return None
    return next((each for each in FORMATS if each.recognises(path)), None)


def read_scan(path: str | Path) -> Scan:
    """Read the mesh or point cloud in a file, in the file's coordinates. Raises ``InputError`` if there is none."""
    found = format_of(Path(path))
    if found is None:
        names = ", ".join(each.name for each in FORMATS)
        raise InputError("not a readable mesh or point cloud", where=path, expected=names)
    return found.read(Path(path))
