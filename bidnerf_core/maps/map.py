"""A map: a field with what localization needs beside it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor, nn

from bidnerf_core.backend import Backend, load_backend
from bidnerf_core.errors import InputError
from bidnerf_core.fields.contract import RadianceField, SceneBounds
from bidnerf_core.io.json import from_plain
from bidnerf_core.io.tensors import read_tensors
from bidnerf_core.localization.problem import on_device
from bidnerf_core.mapping import SurfaceMap
from bidnerf_core.mapping.landmarks import LandmarkMap
from bidnerf_core.maps.description import DESCRIPTION, EXPECTED_PART, MapInfo, load_info
from bidnerf_core.maps.files import load_landmarks, load_surface
from bidnerf_core.maps.weights import checked_weights


@dataclass(frozen=True, eq=False)
class Map:
    """A stored map, ready for use: its field is frozen (no parameter requires a gradient)."""

    info: MapInfo
    field: RadianceField
    surface: SurfaceMap | None = None  # None where it was not baked
    landmarks: LandmarkMap | None = None  # None where none were built

    @property
    def bounds(self) -> SceneBounds:
        return self.info.bounds

    @property
    def has_distances(self) -> bool:
        """Whether the training images determine distances."""
        return self.info.distances

    @property
    def colour_noise(self) -> float | None:
        """Root mean square error of the field's colours (in [0, 1]) on its own training images."""
        return self.info.colour_noise

    def to(self, device: torch.device | str) -> Map:
        """Return the map with its field, surface and landmarks on ``device``; what is not there yet is copied.

        Of all computations with landmarks, only descriptors are compared there, see ``LandmarkMap.to``.
        """
        return on_device(self, device)


def load_map(folder: str | Path, device: torch.device | str = "cpu", baked: bool = True) -> Map:
    """Return the map in ``folder``, on ``device``, with its field built by its backend and frozen.

    ``baked`` determines whether the surface and the landmarks are read. Raises ``InputError`` where the folder is not a map,
    or a damaged one.
    """
    folder = Path(folder)
    info, tensors, surface, landmarks = _read(folder, baked)
    backend, where = load_backend(info.backend, str(folder)), str(folder / DESCRIPTION)
    outline = _outline(backend, info, where)
    if outline is not None:  # before memory is allocated for a field, of whatever size map.json describes
        tensors = checked_weights(outline, tensors, folder / info.weights)
    field, _ = build_field(backend, info, where)
    if outline is None:
        tensors = checked_weights(field, tensors, folder / info.weights)
    cast(nn.Module, field).load_state_dict(tensors)
    cast(nn.Module, field).requires_grad_(False).eval()
    if landmarks is not None:
        cameras = tuple(camera.intrinsics for camera in info.cameras)
        landmarks = replace(landmarks, cameras=cameras, features=info.landmark_features)
    return Map(info, field, surface, landmarks).to(device)


def build_field(backend: Backend, info: MapInfo, where: str) -> tuple[RadianceField, Any]:
    """Return an untrained field (an ``nn.Module``) and its config, as ``info`` describes them."""
    config: Any = from_plain(backend.config_type, info.config, f"{where}: config")
    try:
        field = backend.build(config, info.bounds)
    except ValueError as error:
        raise InputError(f"{where}: backend {info.backend!r} refuses its config: {error}") from error
    if not isinstance(field, nn.Module):
        found = type(field).__name__
        raise InputError(f"{where}: backend {info.backend!r} built a {found}, expected an nn.Module")
    return field, config


def _outline(backend: Backend, info: MapInfo, where: str) -> RadianceField | None:
    """Return the field with only the shapes of its tensors, or None where its backend needs real tensors to build it."""
    try:
        with torch.device("meta"):
            return build_field(backend, info, where)[0]
    except InputError:
        raise
    except Exception:  # a backend may do anything with the values that it lacks
        return None


def _read(
    folder: Path, baked: bool
) -> tuple[MapInfo, dict[str, Tensor], SurfaceMap | None, LandmarkMap | None]:
    """Return parts that belong to the same map, even while a training replaces them."""
    info = load_info(folder)
    while True:
        try:
            weights = read_tensors(folder / info.weights, EXPECTED_PART)
            surface = load_surface(folder / info.surface) if baked and info.surface else None
            landmarks = load_landmarks(folder / info.landmarks) if baked and info.landmarks else None
            return info, weights, surface, landmarks
        except InputError:
            before, info = info, load_info(folder)
            if replace(before, bidnerf="") == replace(info, bidnerf=""):
                raise
