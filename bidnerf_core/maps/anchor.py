"""The geographic anchor of a map: the file ``anchor.json`` next to ``map.json``, which states where on earth
the map lies.

It holds ``latitude`` and ``longitude`` (degrees) and ``height`` (metres above the WGS 84 ellipsoid) of a
point, and ``T_enu_world``, the rows of the 4x4 matrix that maps the map's coordinates, times
``metres_per_unit``, to the east-north-up frame at that point. ``position_sigma`` (metres, along each axis)
and ``orientation_sigma`` (degrees, about each axis) state how accurately the anchor itself is known.
"""

from __future__ import annotations

import contextlib
import json
import math
import re
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.errors import InputError
from bidnerf_core.geometry import SE3, Geodetic, geodetic, pose_from_matrix
from bidnerf_core.io import from_plain, read_json, to_plain, write_file

ANCHOR = "anchor.json"
NEWER = re.compile(r"anchor-\d{8,}-[0-9a-f]{8}\.json")
"""Names of anchors that are about to take the place of ``anchor.json``, see ``MapInfo.anchor``."""
IDENTITY = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))


@dataclass(frozen=True)
class GeographicPose:
    """A camera on the earth: its place, and its rotation in the east-north-up frame at that place."""

    place: Geodetic
    rotation: Float[Tensor, "3 3"]  # R_enu_camera, OpenCV camera axes


@dataclass(frozen=True)
class Anchor:
    """Where on earth a map lies, see the module docstring."""

    latitude: float
    longitude: float
    height: float
    T_enu_world: tuple[tuple[float, ...], ...] = IDENTITY
    metres_per_unit: float = 1.0
    position_sigma: float = 0.0  # metres
    orientation_sigma: float = 0.0  # degrees

    def __post_init__(self) -> None:
        """Raise ``InputError`` for a place off the earth, a matrix that is not a pose, and numbers that are
        not positive.
        """
        self._T_ecef_world  # noqa: B018 (it checks the place and the matrix)
        if not 0 < self.metres_per_unit < math.inf:
            raise InputError(f"metres_per_unit is {self.metres_per_unit}", expected="a positive number")
        if not (0 <= self.position_sigma < math.inf and 0 <= self.orientation_sigma < math.inf):
            raise InputError(where="position_sigma and orientation_sigma", expected="0 or more")

    def plain(self) -> dict[str, Any]:
        """Return the anchor as JSON values."""
        values: dict[str, Any] = to_plain(self)
        return values

    @cached_property
    def _T_ecef_world(self) -> SE3:
        """The map's frame, in metres, in the earth-centred frame."""
        rows = [list(row) for row in self.T_enu_world]
        if [len(row) for row in rows] != [4] * 4:
            raise InputError(where="T_enu_world", expected="4 rows of 4 numbers")
        T_enu_world = pose_from_matrix(torch.tensor(rows, dtype=torch.float64), "T_enu_world")
        return Geodetic(self.latitude, self.longitude, self.height).T_ecef_enu @ T_enu_world

    def geographic(self, T_world_camera: SE3) -> GeographicPose:
        """Return a camera's place, and its rotation relative to east, north and up there, not at the anchor."""
        pose = T_world_camera.to("cpu", torch.float64)
        T_ecef_camera = self._T_ecef_world @ SE3(pose.rotation, pose.translation * self.metres_per_unit)
        place = geodetic(T_ecef_camera.translation)
        return GeographicPose(place, place.T_ecef_enu.rotation.mT @ T_ecef_camera.rotation)

    def T_world_camera(self, pose: GeographicPose) -> SE3:
        """Convert the pose of a camera on the earth to the map's frame; the inverse of ``geographic``."""
        local = pose.place.T_ecef_enu
        inside = self._T_ecef_world.inverse() @ SE3(
            local.rotation @ pose.rotation.double(), local.translation
        )
        return SE3(inside.rotation, inside.translation / self.metres_per_unit)


def load_anchor(folder: Path, newer: str | None = None) -> Anchor | None:
    """Return the anchor in the folder of a map, or None if there is none. Raises ``InputError`` for a damaged
    one.

    ``newer`` is the name of the file that counts in place of ``anchor.json`` if it exists, see ``MapInfo.anchor``.
    """
    path = folder / ANCHOR if newer is None or not (folder / newer).exists() else folder / newer
    if not path.exists():
        return None
    found = read_json(path, "the anchor of a map")
    return None if found is None and path.name == newer else from_plain(Anchor, found, str(path))


def save_anchor(folder: Path, anchor: Anchor) -> None:
    """Write an anchor into the folder of a map, replacing an existing one."""
    write_file(folder / ANCHOR, anchor_bytes(anchor))
    for file in folder.iterdir():
        if NEWER.fullmatch(file.name):
            file.unlink()


def anchor_bytes(anchor: Anchor | None) -> bytes:
    """Return the content of a file with an anchor; None means that there is none."""
    plain = None if anchor is None else anchor.plain()
    return (json.dumps(plain, indent=1, allow_nan=False) + "\n").encode()


def put_in_place(folder: Path, newer: str) -> None:
    """Replace ``anchor.json`` by the file ``newer``, which ``map.json`` names.

    If this is interrupted, ``newer`` still exists and is the one that counts.
    """
    with contextlib.suppress(OSError, InputError):
        if read_json(folder / newer, "the anchor of a map") is not None:
            (folder / newer).replace(folder / ANCHOR)
            return
        (folder / ANCHOR).unlink(missing_ok=True)
        (folder / newer).unlink()


def scaled_anchor(anchor: Anchor, factor: float) -> Anchor:
    """Return the anchor of a map whose lengths were multiplied by ``factor``."""
    return replace(anchor, metres_per_unit=anchor.metres_per_unit / factor)
