"""Surveying formats: LAS and LAZ with laspy, E57 with pye57, which are extras."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bidnerf_core.errors import InputError
from bidnerf_scan.extras import library
from bidnerf_scan.scan import Scan, in_unit_range, joined


def recognises_las(path: Path) -> bool:
    """Return whether the file has the extension of LAS, compressed or not."""
    return path.suffix.lower() in (".las", ".laz")


def recognises_e57(path: Path) -> bool:
    """Return whether the file has the extension of E57."""
    return path.suffix.lower() == ".e57"


def read_las(path: Path) -> Scan:
    """Return the points of a LAS or LAZ file."""
    laspy = library("laspy", f"{path}: reading it", "laspy[lazrs]")
    try:
        with laspy.open(str(path)) as file:
            header = file.header
            count, size = int(header.point_count), path.stat().st_size
            least = 1 if path.suffix.lower() == ".laz" else 8 * header.point_format.size
            if count * least > 8 * size:
                raise InputError(
                    f"declares {count:,} points, but its {size:,} bytes are too few for them; is the file truncated?",
                    where=path,
                )
            rows = file.read()
        points = np.stack([np.asarray(axis, np.float64) for axis in (rows.x, rows.y, rows.z)], axis=-1)
        if not {"red", "green", "blue"} <= set(rows.point_format.dimension_names):
            return Scan(points)
        rgb = np.stack([np.asarray(c) for c in (rows.red, rows.green, rows.blue)], -1)
    except InputError:
        raise
    except Exception as error:  # laspy and its decompressors raise errors of many types
        raise InputError(
            f"not readable ({type(error).__name__}: {error})", where=path, expected="LAS; is it truncated?"
        ) from error
    if not rgb.size or rgb.max() == 0:
        return Scan(points)  # the colour fields are unused
    return Scan(points, in_unit_range(rgb))  # the standard uses 16 bits; many programs write 8


def read_e57(path: Path) -> Scan:
    """Read the points of all scans of an E57 file, each transformed by its pose."""
    pye57 = library("pye57", f"{path}: reading it", "pye57")
    parts = []
    try:
        file = pye57.E57(str(path))
        for number in range(file.scan_count):
            count = int(file.get_header(number).point_count)
            if count > path.stat().st_size:
                raise InputError(
                    f"declares {count:,} points, but its {path.stat().st_size:,} bytes are too few for them;"
                    " is the file truncated?",
                    where=path,
                )
            rows = file.read_scan(number, colors=True, intensity=False, ignore_missing_fields=True)
            points = np.stack([rows[f"cartesian{axis}"] for axis in "XYZ"], axis=-1).astype(np.float64)
            rgb = None
            if "colorRed" in rows:
                rgb = in_unit_range(np.stack([rows[f"color{c}"] for c in ("Red", "Green", "Blue")], -1))
            parts.append(Scan(points, rgb))
    except InputError:
        raise
    except Exception as error:  # pye57 passes on errors of a C++ library
        raise InputError(
            f"not readable ({type(error).__name__}: {error})", where=path, expected="E57; is it truncated?"
        ) from error
    if not parts:
        raise InputError("holds no scan", where=path, expected="E57 with points")
    return joined(parts)
