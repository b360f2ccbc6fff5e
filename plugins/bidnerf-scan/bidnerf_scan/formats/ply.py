"""PLY: point clouds with the core's reader, meshes with trimesh."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bidnerf_core.errors import InputError
from bidnerf_core.io import check_ply_size, read_ply, read_ply_header
from bidnerf_scan.formats import by_trimesh
from bidnerf_scan.scan import Scan, colours_of

EXPECTED = "a PLY file of a mesh or of points"
SPLATS = ({"opacity", "scale_0"}, {"packed_position"})
"""Properties of Gaussian splats, which are not scans."""
COLOURS = (("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"))


def recognises(path: Path) -> bool:
    """Return whether the file is a PLY without Gaussian splats."""
    if path.suffix.lower() != ".ply":
        return False
    try:
        header = read_ply_header(path)
    except InputError:  # reported when it is read
        with path.open("rb") as file:
            return file.read(3) == b"ply"
    vertex = header.elements.get("vertex")
    return vertex is None or not any(splat <= set(vertex.properties) for splat in SPLATS)


def read(path: Path) -> Scan:
    """Return the mesh or the points of a PLY file."""
    header = read_ply_header(path, EXPECTED)
    vertex, face = header.elements.get("vertex"), header.elements.get("face")
    if vertex is None or not {"x", "y", "z"} <= set(vertex.properties):
        raise InputError("no vertices with x, y and z", where=path, expected=EXPECTED)
    if vertex.count == 0:
        raise InputError("holds no vertices", where=path, expected=EXPECTED)
    if face is not None and face.count:
        check_ply_size(path, header)
        return by_trimesh.read(path, EXPECTED)
    rows = read_ply(path, EXPECTED).get("vertex")
    if rows is None:
        raise InputError("its vertices hold lists of numbers", where=path, expected=EXPECTED)
    points = np.stack([rows[axis].astype(np.float64) for axis in "xyz"], axis=-1)
    return Scan(points, colours_of(rows, *COLOURS))
