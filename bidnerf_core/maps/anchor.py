"""The geographic anchor of a map, which states where on earth the map lies: key ``anchor`` of ``map.json``.

A file ``anchor.json`` next to ``map.json``, which users may write, takes its place until the map is saved. An anchor
holds ``latitude`` and ``longitude`` (degrees) and ``height`` (metres above the WGS 84 ellipsoid) of a point, and
``T_enu_world``, the rows of the 4x4 matrix that maps the map's coordinates, times ``metres_per_unit``, to the
east-north-up frame at that point. ``position_sigma`` (metres, along each axis) and ``orientation_sigma`` (degrees,
about each axis) state how accurately the anchor itself is known.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import torch

from bidnerf_core.errors import InputError
from bidnerf_core.geometry import SE3, pose_from_matrix
from bidnerf_core.io import from_plain, read_json

ANCHOR = "anchor.json"


@dataclass(frozen=True)
class Anchor:
    """Where on earth a map lies, see the module docstring."""

    latitude: float
    longitude: float
    height: float
    T_enu_world: tuple[tuple[float, ...], ...] = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))  # fmt: skip
    metres_per_unit: float = 1.0
    position_sigma: float = 0.0  # metres
    orientation_sigma: float = 0.0  # degrees

    def __post_init__(self) -> None:
        """Raise ``InputError`` for a place off the earth, a matrix that is no pose, and a length or angle out of range."""
        # The height is in metres above or below the ellipsoid.
        for name, most in (("latitude", 90.0), ("longitude", 180.0), ("height", 1e6)):
            if not abs(getattr(self, name)) <= most:
                raise InputError(f"{name} is {getattr(self, name)}", expected=f"{-most:g} to {most:g}")
        self.pose  # noqa: B018 (it checks the matrix)
        if not 0 < self.metres_per_unit < math.inf:
            raise InputError(f"metres_per_unit is {self.metres_per_unit}", expected="a positive number")
        if not (0 <= self.position_sigma < math.inf and 0 <= self.orientation_sigma < math.inf):
            raise InputError(where="position_sigma and orientation_sigma", expected="0 or more")

    @cached_property
    def pose(self) -> SE3:
        """T_enu_world: the map's frame, in metres, in the east-north-up frame at the anchor."""
        rows = [list(row) for row in self.T_enu_world]
        if [len(row) for row in rows] != [4] * 4:
            raise InputError(where="T_enu_world", expected="4 rows of 4 numbers")
        return pose_from_matrix(torch.tensor(rows, dtype=torch.float64), "T_enu_world")

    def scaled(self, factor: float) -> Anchor:
        """Return the anchor of the map after its lengths were multiplied by ``factor``."""
        return replace(self, metres_per_unit=self.metres_per_unit / factor)


def load_anchor(folder: Path, newer: str = "") -> Anchor | None:
    """Return the anchor in a file of its own in the folder of a map, or None if there is none.

    This is ``anchor.json``, or the file ``newer`` by which earlier versions replaced it. Raises ``InputError`` for a damaged
    one.
    """
    path = folder / newer if newer and (folder / newer).exists() else folder / ANCHOR
    if not path.exists():
        return None
    found = read_json(path, "the anchor of a map")
    return None if found is None and newer else from_plain(Anchor, found, str(path))
