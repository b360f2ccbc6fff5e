"""Storage of maps: a folder of JSON and safetensors, which cannot run code when they are read.

``map.json`` describes the map and names the files of its tensors. Files are written under new names first and
``map.json`` is replaced atomically at the end: whenever writing stops, the folder holds one complete map.
"""

from __future__ import annotations

import contextlib
import json
import re
import secrets
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal, cast

import torch
from safetensors.torch import save as tensors_to_bytes
from torch import Tensor, nn

from bidnerf_core.backend import Backend
from bidnerf_core.camera.intrinsics import Intrinsics
from bidnerf_core.captures.cameras import PoseRefinement, StoredCamera
from bidnerf_core.captures.report import CaptureReport
from bidnerf_core.errors import InputError, amount
from bidnerf_core.fields.contract import RadianceField, SceneBounds
from bidnerf_core.geometry.se3 import SE3
from bidnerf_core.io.files import read_file, write_file
from bidnerf_core.io.serialization import from_plain, to_plain
from bidnerf_core.localization.problem import on_device
from bidnerf_core.mapping import SurfaceMap, surface_tensors
from bidnerf_core.mapping.landmark_tensors import landmark_tensors
from bidnerf_core.mapping.landmarks import LandmarkMap
from bidnerf_core.maps.parts import load_landmarks, load_surface
from bidnerf_core.maps.tensors import checked_weights, packed, read_tensors
from bidnerf_core.registry import load_backend
from bidnerf_core.training import TrainingState

FORMAT = "bidnerf map"
VERSION = 1
DESCRIPTION = "map.json"
PARTS = (
    r"((weights|training|surface|landmarks)-\d{8,}-[0-9a-f]{8}\.safetensors|capture-\d{8,}-[0-9a-f]{8}\.json)"
)
OURS = re.compile(rf"{PARTS}|\.({PARTS}|map\.json)\.[0-9a-f]{{8}}")
"""Names of the files that saving may leave behind; other files in the folder are never removed."""


LandmarkSource = Literal["photos", "rendered images"]


@dataclass(frozen=True)
class MapInfo:
    """The content of ``map.json``."""

    backend: str
    config: dict[str, Any]
    bounds: SceneBounds
    step: int  # training steps done
    complete: bool  # whether training has finished
    data: str = ""  # name of the dataset's folder
    seconds: float = 0.0  # of training
    cameras: tuple[StoredCamera, ...] = ()
    pose_refinement: PoseRefinement | None = None  # of the cameras; None if nothing is known
    distances: bool = True  # False if all images are from one place, so that they do not determine distances
    sparse_depth: int = 0  # number of training pixels whose depth came from structure from motion
    weights: str = ""  # file names
    training: str | None = None  # state that resuming needs; dropped when training is complete
    surface: str | None = None  # baked from these weights
    landmarks: str | None = None
    landmark_source: LandmarkSource | None = None  # the images they were built from, where that is recorded
    capture: str | None = None  # record of the photos that gave the landmarks
    colour_noise: float | None = None  # root mean square error of rendered colours on training images
    bidnerf: str = field(default_factory=lambda: version("bidnerf"))
    format: str = FORMAT
    version: int = VERSION


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


def save_map(folder: Path, info: MapInfo, state: TrainingState) -> MapInfo:
    """Write a map, and remove the files of an earlier one once the new one is completely written."""
    name = f"{state.step:08d}-{secrets.token_hex(4)}.safetensors"
    training = None if info.complete else f"training-{name}"
    info = replace(
        info, weights=f"weights-{name}", training=training, surface=None, landmarks=None, landmark_source=None,
        capture=None, colour_noise=None,
    )  # fmt: skip
    description = json.dumps(to_plain(info), indent=1, allow_nan=False).encode()
    folder.mkdir(parents=True, exist_ok=True)
    try:
        write_file(folder / info.weights, tensors_to_bytes(packed(state.field)))
        if info.training is not None:
            write_file(folder / info.training, tensors_to_bytes(packed(state.optimizer)))
        write_file(folder / DESCRIPTION, description)
    finally:
        _sweep(folder)
    return info


def save_surface(folder: Path, of: MapInfo, surface: SurfaceMap) -> MapInfo:
    """Add the surface that was baked from map ``of`` to it, replacing an earlier one.

    Raises ``InputError`` where another training has replaced that map meanwhile.
    """
    return _save_part(folder, of, "surface", tensors_to_bytes(surface_tensors(surface)))


def save_landmarks(
    folder: Path, of: MapInfo, landmarks: LandmarkMap, colour_noise: float | None = None,
    source: LandmarkSource = "photos",
) -> MapInfo:  # fmt: skip
    """Add landmarks to map ``of``, replacing earlier ones, and the error with which the field renders its training images.

    ``source`` is the kind of images that the landmarks were built from. Raises ``InputError`` where another training has
    replaced that map meanwhile.
    """
    content = tensors_to_bytes(landmark_tensors(landmarks))
    return _save_part(folder, of, "landmarks", content, colour_noise=colour_noise, landmark_source=source)


def save_capture(folder: Path, of: MapInfo, capture: CaptureReport) -> MapInfo:
    """Add the record of its photos to map ``of``, replacing an earlier one.

    Raises ``InputError`` where another training has replaced that map meanwhile.
    """
    content = json.dumps(to_plain(capture), indent=1, allow_nan=False).encode()
    return _save_part(folder, of, "capture", content, "json")


def _save_part(
    folder: Path,
    of: MapInfo,
    part: str,
    content: bytes,
    ending: str = "safetensors",
    **facts: float | str | None,
) -> MapInfo:
    """Add a file to a map under the name of a part of its description."""
    if load_info(folder).weights != of.weights:
        raise InputError(f"{folder}: was trained anew while its {part} was made; bake it again")
    name = f"{part}-{of.step:08d}-{secrets.token_hex(4)}.{ending}"
    info = replace(load_info(folder), **{part: name}, **facts)  # type: ignore[arg-type]
    description = json.dumps(to_plain(info), indent=1, allow_nan=False).encode()
    try:
        write_file(folder / name, content)
        write_file(folder / DESCRIPTION, description)
    finally:
        _sweep(folder)
    return info


def cameras_of(info: MapInfo) -> list[tuple[Intrinsics, SE3]]:
    """Return the cameras of the training images with their ``T_world_camera`` (float64)."""
    return [(c.intrinsics, c.pose) for c in info.cameras]


def load_info(folder: Path) -> MapInfo:
    """Return the content of ``map.json``, checked. Raises ``InputError`` where it does not describe a map of this version."""
    path = folder / DESCRIPTION
    if not folder.is_dir():
        what = "is a file" if folder.exists() else "no such folder"
        raise InputError(f"{folder}: {what}, expected a map: a folder as written by 'bidnerf train'")
    if not path.exists():
        raise InputError(f"{folder}: no {DESCRIPTION} in it, expected a map as written by 'bidnerf train'")
    content = read_file(path, "the description of a map")
    try:
        found = json.loads(content)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: not JSON ({error}), expected the description of a map") from error
    if not isinstance(found, dict) or found.get("format") != FORMAT:
        raise InputError(f'{path}: not the description of a map, expected "format": "{FORMAT}"')
    if found.get("version") != VERSION:
        newer = isinstance(found.get("version"), int) and found["version"] > VERSION
        advice = "it was written by a newer bidnerf, update yours" if newer else "train the map anew"
        raise InputError(f"{path}: version {found.get('version')!r}, expected {VERSION}; {advice}")
    info = from_plain(MapInfo, found, str(path))
    for name in (info.weights, info.training, info.surface, info.landmarks, info.capture):
        if name is not None and (not name or Path(name).name != name):
            raise InputError(f"{path}: names {name!r}, expected the name of a file beside it")
    for name in (camera.name for camera in info.cameras if not camera.is_rigid):
        raise InputError(f"{path}: pose of camera {name!r} is not a rigid transform, expected 4x4 rows")
    return info


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
        landmarks = replace(landmarks, cameras=tuple(camera.intrinsics for camera in info.cameras))
    return Map(info, field, surface, landmarks).to(device)


def load_state(folder: Path, info: MapInfo, field: RadianceField) -> TrainingState:
    """Return the state from which the interrupted training of ``field`` can be resumed."""
    if info.training is None:
        raise InputError(f"{folder}: training is complete ({amount(info.step, 'step')}), nothing to resume")
    path = folder / info.weights
    weights = checked_weights(field, read_tensors(path), path)
    return TrainingState(info.step, weights, read_tensors(folder / info.training))


def _read(
    folder: Path, baked: bool
) -> tuple[MapInfo, dict[str, Tensor], SurfaceMap | None, LandmarkMap | None]:
    """Return parts that belong to the same map, even while a training replaces them."""
    info = load_info(folder)
    while True:
        try:
            weights = read_tensors(folder / info.weights)
            surface = load_surface(folder / info.surface) if baked and info.surface else None
            landmarks = load_landmarks(folder / info.landmarks) if baked and info.landmarks else None
            return info, weights, surface, landmarks
        except InputError:
            before, info = info, load_info(folder)
            if replace(before, bidnerf="") == replace(info, bidnerf=""):
                raise


def _sweep(folder: Path) -> None:
    """Remove the files of earlier and of interrupted saves that ``map.json`` does not name."""
    try:
        found = json.loads((folder / DESCRIPTION).read_bytes())
        kept = {found.get(name) for name in ("weights", "training", "surface", "landmarks", "capture")}
    except FileNotFoundError:
        kept = set()
    except (OSError, ValueError, AttributeError):  # damaged: which files are in use is unknown
        return
    for file in list(folder.iterdir()):
        if OURS.fullmatch(file.name) and file.name not in kept:
            with contextlib.suppress(OSError):  # a left-over file does no harm
                file.unlink()
