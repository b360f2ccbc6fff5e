"""Check that photos show the scene of a map, so that they may be baked into it."""

from __future__ import annotations

from collections.abc import Sequence

from bidnerf_core.captures import stored_cameras
from bidnerf_core.errors import InputError
from bidnerf_core.fields import RadianceField
from bidnerf_core.frames import View
from bidnerf_core.mapping import colour_noise
from bidnerf_core.maps.description import MapInfo

UNLIKE, UNLIKE_ITS_OWN, UNLIKE_ANY = 0.2, 2.0, 0.3
"""Smallest difference (RMS) between rendered and photographed colours that indicates another scene: absolute;
relative to that between the field and the photos the map was built from; and absolute if the latter is
unknown, as in a map that was never baked."""


def check_same_scene(info: MapInfo, field: RadianceField, views: Sequence[View], where: str) -> None:
    """Raise ``InputError`` for photos of another scene: none of them was used to build the map, and they are
    unlike its field.

    The message begins with ``where``.
    """
    own = {(camera.name, camera.T_world_camera) for camera in info.cameras}
    known = any((c.name, c.T_world_camera) in own for c in stored_cameras(views))
    if known or not own:
        return
    check_alike(info, field, views, where)


def check_alike(info: MapInfo, field: RadianceField, views: Sequence[View], where: str) -> None:
    """Raise ``InputError`` for photos that are unlike the field, regardless of whether the map was built from them."""
    off, usual = colour_noise(field, info.bounds, views), info.colour_noise
    if off > (UNLIKE_ANY if usual is None else max(UNLIKE, UNLIKE_ITS_OWN * usual)):
        raise InputError(
            f"built from {info.data or 'other views'!r}, and its renderings differ from the photos by"
            f" {off:.0%} of the range of colours;",
            where=where,
            expected="photos of the same scene, with poses in the coordinates of the map",
        )
