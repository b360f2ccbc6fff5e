"""Files of Gaussians: what reads and writes which."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from bidnerf_core.errors import InputError
from bidnerf_gaussians.formats import checkpoint, gltf, ply, sog, splat, spz
from bidnerf_gaussians.gaussians import Gaussians


@dataclass(frozen=True)
class Format:
    """One kind of file."""

    name: str
    recognises: Callable[[Path], bool]  # looks at the name and the first bytes
    read: Callable[[Path], Gaussians]  # raises InputError where the file is damaged
    convention: str  # of the axes that its writers follow; which way is up is nowhere written
    up: tuple[float, float, float] = (0.0, -1.0, 0.0)  # as in COLMAP's and OpenCV's cameras, if anything


FORMATS = (
    Format("PLY of splats", ply.recognises, ply.read, "as trained (COLMAP: y down, z forward)"),
    Format("compressed PLY", ply.recognises_compressed, ply.read_compressed, "as trained, as in a PLY"),
    Format(".splat", splat.recognises, splat.read, "as trained, as in a PLY"),
    Format("SPZ", spz.recognises, spz.read, "right, up, back in the file; y and z are turned as for a PLY"),
    Format("SOG", sog.recognises, sog.read, "as trained, as in a PLY"),
    Format("glTF", gltf.recognises, gltf.read, "y up, as glTF has it; nodes are applied", (0.0, 1.0, 0.0)),
    Format(
        "checkpoint of gsplat or splatfacto", checkpoint.recognises, checkpoint.read, "those of the training"
    ),
)


def format_of(path: Path) -> Format | None:
    """Return the format of a file or folder, or None where it is none of these."""
    return next((each for each in FORMATS if each.recognises(path)), None)


def read_gaussians(path: Path) -> Gaussians:
    """Return the Gaussians in a file. Raises ``InputError`` for another kind of file, and for a damaged one."""
    found = format_of(path)
    if found is None:
        names = ", ".join(each.name for each in FORMATS)
        raise InputError(f"{path}: no file of Gaussians that can be read, expected one of: {names}")
    return found.read(path)


def write_gaussians(path: Path, gaussians: Gaussians) -> None:
    """Write a .ply or .spz file. Raises ``InputError`` for another ending."""
    writers = {".ply": ply.write, ".spz": spz.write}
    if path.suffix.lower() not in writers:
        raise InputError(
            f"{path}: cannot write {path.suffix or 'a name without ending'}, expected .ply or .spz"
        )
    writers[path.suffix.lower()](path, gaussians)
