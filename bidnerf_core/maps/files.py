"""The files of a map: JSON and safetensors, which cannot run code when they are read.

``map.json`` describes the map and names the files of its tensors. Files are written under new names first and
``map.json`` is replaced atomically at the end: whenever writing stops, the folder holds one complete map.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import secrets
from dataclasses import replace
from pathlib import Path

from safetensors.torch import save as tensors_to_bytes

from bidnerf_core.captures.report import CaptureReport
from bidnerf_core.errors import InputError, amount
from bidnerf_core.fields.contract import RadianceField
from bidnerf_core.io.files import write_file
from bidnerf_core.io.json import from_plain, read_json, to_plain
from bidnerf_core.io.tensors import load_part, packed, read_tensors
from bidnerf_core.mapping import SurfaceMap, surface_from_tensors, surface_tensors
from bidnerf_core.mapping.landmark_tensors import landmark_tensors, landmarks_from_tensors
from bidnerf_core.mapping.landmarks import LandmarkMap
from bidnerf_core.maps.description import DESCRIPTION, EXPECTED_PART, LandmarkSource, MapInfo, load_info
from bidnerf_core.maps.weights import checked_weights
from bidnerf_core.training import TrainingState

PARTS = (
    r"((weights|training|surface|landmarks)-\d{8,}-[0-9a-f]{8}\.safetensors|capture-\d{8,}-[0-9a-f]{8}\.json)"
)
BAKED = "a safetensors file, which 'bidnerf bake' writes anew"
OURS = re.compile(rf"{PARTS}|\.({PARTS}|map\.json)\.[0-9a-f]{{8}}")
"""Names of the files that saving may leave behind; other files in the folder are never removed."""


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
    replaced that map meanwhile, and where the detector of the landmarks has no name by which a query could find it.
    """
    if not landmarks.features:
        raise InputError(f"{folder}: landmarks of a detector without a name; expected one that is registered")
    content = tensors_to_bytes(landmark_tensors(landmarks))
    return _save_part(
        folder, of, "landmarks", content, colour_noise=colour_noise, landmark_source=source,
        landmark_features=landmarks.features,
    )  # fmt: skip


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


def load_state(folder: Path, info: MapInfo, field: RadianceField) -> TrainingState:
    """Return the state from which the interrupted training of ``field`` can be resumed."""
    if info.training is None:
        raise InputError(f"{folder}: training is complete ({amount(info.step, 'step')}), nothing to resume")
    path = folder / info.weights
    weights = checked_weights(field, read_tensors(path, EXPECTED_PART), path)
    return TrainingState(info.step, weights, read_tensors(folder / info.training, EXPECTED_PART))


def load_surface(path: Path) -> SurfaceMap:
    """Return the baked surface of a map. Raises ``InputError`` where the file does not hold the tensors of one."""
    return load_part(path, surface_from_tensors, "a baked surface", BAKED)


def load_landmarks(path: Path) -> LandmarkMap:
    """Return the landmarks of a map. Raises ``InputError`` where the file does not hold the tensors of landmarks."""
    return load_part(path, landmarks_from_tensors, "landmarks", BAKED)


def load_capture(path: Path) -> CaptureReport:
    """Return the record of a capture. Raises ``InputError`` where the file does not hold one."""
    expected = "the record of a capture, which 'bidnerf bake' with --data writes anew"
    return from_plain(CaptureReport, read_json(path, expected), str(path))


def _sweep(folder: Path) -> None:
    """Remove the files of earlier and of interrupted saves that ``map.json`` does not name."""
    exists = os.path.lexists(folder / DESCRIPTION)
    try:
        found = read_json(folder / DESCRIPTION, "the description of a map") if exists else {}
        kept = {found.get(name) for name in ("weights", "training", "surface", "landmarks", "capture")}
    except (InputError, AttributeError):  # damaged: which files are in use is unknown
        return
    for file in list(folder.iterdir()):
        if OURS.fullmatch(file.name) and file.name not in kept:
            with contextlib.suppress(OSError):  # a left-over file does no harm
                file.unlink()
