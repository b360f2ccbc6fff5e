"""What holds of any map that can be localized in, whether trained here or not: its unit, origin, cameras and device."""

from __future__ import annotations

import copy
from typing import TypeVar

import torch
from jaxtyping import Float
from torch import Tensor, nn

from bidnerf_core.camera import Intrinsics
from bidnerf_core.devices import move_to, working_device
from bidnerf_core.errors import InputError
from bidnerf_core.geometry import LengthUnit
from bidnerf_core.localization import SceneMap

_Map = TypeVar("_Map", bound=SceneMap)


def unit_of(scene: SceneMap) -> LengthUnit:
    """Return the unit of a map's lengths; "units" for maps that do not state a unit, such as other projects' fields."""
    return getattr(scene, "unit", "units")


def origin_of(scene: object) -> Float[Tensor, "3"]:
    """Return the origin of a map's own coordinates in its world frame (float64), see ``Map.origin``; 0 for maps that state no origin."""
    return torch.tensor(getattr(scene, "origin", (0.0, 0.0, 0.0)), dtype=torch.float64)


def landmark_cameras(scene: SceneMap) -> tuple[Intrinsics, ...]:
    """Return the cameras of the images from which a map's landmarks were built; photos without a focal length may be from them as well."""
    return () if scene.landmarks is None else scene.landmarks.cameras


def move_map_to(scene: _Map, device: torch.device | str) -> _Map:
    """Return a map with field, surface and landmarks on ``device``; the given map is not modified.

    Raises ``InputError`` for an unavailable device, and if the field cannot be moved.
    """
    field = scene.field
    if not isinstance(field, nn.Module):
        raise InputError(
            f"the map's field is a {type(field).__name__}", where=f"device {device}", expected="an nn.Module"
        )
    parts = {"field": field, "surface": scene.surface, "landmarks": scene.landmarks}
    there = move_to(parts, working_device(device))
    if there is parts:
        return scene
    found = copy.copy(scene)
    vars(found).update(there)  # although the map may be a frozen dataclass
    return found
