"""Files of Gaussians: which format is read and written by what."""

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
    recognises: Callable[[Path], bool]  # examines the name and the first bytes
    read: Callable[[Path], Gaussians]  # raises InputError if the file is damaged
    convention: str  # of the axes that its writers follow; the upward direction is stored nowhere
    up: tuple[float, float, float] = (0.0, -1.0, 0.0)  # as in COLMAP's and OpenCV's cameras, if anything


FORMATS = (
    Format(
        "PLY of 2D Gaussian Splatting, whose discs become thin Gaussians",
        ply.recognises_discs,
        ply.read,
        "as trained, as in a PLY",
    ),
    Format("PLY of splats", ply.recognises, ply.read, "as trained (COLMAP: y down, z forward)"),
    Format("compressed PLY", ply.recognises_compressed, ply.read_compressed, "as trained, as in a PLY"),
    Format(".splat", splat.recognises, splat.read, "as trained, as in a PLY"),
    Format("SPZ", spz.recognises, spz.read, "right, up, back in the file; y and z are negated as for a PLY"),
    Format("SOG", sog.recognises, sog.read, "as trained, as in a PLY"),
    Format(
        "glTF",
        gltf.recognises,
        gltf.read,
        "y up, as glTF prescribes; node transforms are applied",
        (0.0, 1.0, 0.0),
    ),
    Format("checkpoint of gsplat or splatfacto", checkpoint.recognises, checkpoint.read, "those of the training"),
)


def format_of(path: Path) -> Format | None:
    """Return the format of a file or folder, or None if it is none of these."""
    return next((each for each in FORMATS if each.recognises(path)), None)


def read_gaussians(path: Path) -> Gaussians:
    """Read the Gaussians in a file. Raises ``InputError`` for another kind of file, and for a damaged one."""
    found = format_of(path)
    if found is None:
        names = ", ".join(each.name for each in FORMATS)
        raise InputError("not a readable file of Gaussians", where=path, expected=f"one of: {names}")
    return found.read(path)


def write_gaussians(path: Path, gaussians: Gaussians) -> None:
    """Write a .ply or .spz file. Raises ``InputError`` for another file extension."""
    writers = {".ply": ply.write, ".spz": spz.write}
    if path.suffix.lower() not in writers:
        raise InputError(
            f"cannot write {path.suffix or 'a name without extension'}", where=path, expected=".ply or .spz"
        )
    writers[path.suffix.lower()](path, gaussians)
