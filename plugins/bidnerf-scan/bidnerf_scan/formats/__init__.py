"""Files of meshes and point clouds, told from their names and first bytes."""

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
    up: str  # axis that is upwards by its convention
    convention: str  # how binding that is
    recognises: Callable[[Path], bool]
    read: Callable[[Path], Scan]


FORMATS = (
    Format("PLY", "+z", "as most scans have it; PLY states none", ply.recognises, ply.read),
    Format("OBJ", "+y", "as most programs write it; OBJ states none", obj.recognises, obj.read),
    Format("glTF", "+y", "as glTF prescribes, in metres", gltf.recognises, gltf.read),
    Format("PCD", "+z", "as most scans have it; PCD states none", pcd.recognises, pcd.read),
    Format("LAS", "+z", "as LAS prescribes", survey.recognises_las, survey.read_las),
    Format("E57", "+z", "as E57 prescribes, in metres", survey.recognises_e57, survey.read_e57),
)
"""All formats, of which one at most recognises a file."""


def format_of(path: Path) -> Format | None:
    """Return the format of a file, or None where it has none of these."""
    if not path.is_file():
        return None
    return next((each for each in FORMATS if each.recognises(path)), None)


def read_scan(path: str | Path) -> Scan:
    """Return the mesh or the point cloud in a file, in the file's coordinates. Raises ``InputError`` where there is none."""
    found = format_of(Path(path))
    if found is None:
        names = ", ".join(each.name for each in FORMATS)
        raise InputError(f"{path}: no mesh or point cloud that can be read, expected {names}")
    return found.read(Path(path))
