"""The files of a map: JSON and safetensors, which cannot run code when they are read.

``map.json`` describes the map and names the files of its tensors. Files are written under new names first and
``map.json`` is replaced atomically at the end: whenever writing stops, the folder holds one complete map. Only ``anchor.json``
has a fixed name, since users write it: a new one counts from its own file, which ``map.json`` names, until it is renamed.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
import secrets
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import torch
from safetensors.torch import save as tensors_to_bytes
from torch import nn

from bidnerf_core.captures import CaptureReport
from bidnerf_core.errors import InputError, amount
from bidnerf_core.fields import RadianceField, ScaledField, trained_field
from bidnerf_core.io import (
    from_plain,
    load_part,
    output_folder,
    packed,
    read_json,
    read_tensors,
    to_plain,
    write_file,
)
from bidnerf_core.mapping import (
    LandmarkMap,
    SurfaceMap,
    landmark_tensors,
    landmarks_from_tensors,
    surface_from_tensors,
    surface_tensors,
)
from bidnerf_core.maps.anchor import ANCHOR, NEWER, Anchor, anchor_bytes, put_in_place
from bidnerf_core.maps.description import DESCRIPTION, EXPECTED_PART, LandmarkSource, MapInfo, load_info
from bidnerf_core.maps.weights import checked_weights
from bidnerf_core.training import TrainingState

PART_NAMES = ("weights", "training", "surface", "landmarks", "capture", "anchor")
PARTS = r"((weights|training|surface|landmarks)-\d{8,}-[0-9a-f]{8}\.safetensors|(capture|anchor)-\d{8,}-[0-9a-f]{8}\.json)"
BAKED = "a safetensors file, which 'bidnerf bake' can recreate"
OURS = re.compile(rf"{PARTS}|\.({PARTS}|map\.json)\.[0-9a-f]{{8}}")
"""Names of the files that saving may leave behind; other files in the folder are never removed."""


def save_map(
    folder: Path, info: MapInfo, state: TrainingState, surface: SurfaceMap | None = None,
    landmarks: LandmarkMap | None = None, capture: CaptureReport | None = None,
    anchor: Anchor | Literal["kept"] | None = None,
) -> MapInfo:  # fmt: skip
    """Write a map, and remove the files of an earlier one once the new one is complete.

    Parts that are not given, such as a surface that was baked from earlier weights, are dropped from the description, and so is
    the anchor, which is that of the earlier map unless it is "kept".
    """
    parts: dict[str, Callable[[], bytes]] = {"weights": lambda: tensors_to_bytes(packed(state.field))}
    if not info.complete:
        parts["training"] = lambda: tensors_to_bytes(packed(state.optimizer))
    if surface is not None:
        parts["surface"] = lambda: tensors_to_bytes(surface_tensors(surface))
    if landmarks is not None:
        _check_features(landmarks, folder)
        parts["landmarks"] = lambda: tensors_to_bytes(landmark_tensors(landmarks))
    else:
        info = replace(info, landmark_source=None, colour_noise=None)
    if capture is not None:
        parts["capture"] = lambda: _json(capture)
    if not isinstance(anchor, str) and (anchor is not None or (folder / ANCHOR).exists()):
        parts["anchor"] = lambda: anchor_bytes(anchor)
    names = {part: _file_name(part, state.step) for part in parts}
    named: dict[str, Any] = dict.fromkeys(PART_NAMES) | names
    info = replace(info, **named)
    description = _json(info)
    folder.mkdir(parents=True, exist_ok=True)
    _finish_anchor(folder)  # of a save that was stopped: the new description will no longer name it
    try:
        for part, content in parts.items():
            write_file(folder / names[part], content())
        write_file(folder / DESCRIPTION, description)
    finally:
        _sweep(folder)
    return info


def save_surface(folder: Path, of: MapInfo, surface: SurfaceMap) -> MapInfo:
    """Add to map ``of`` the surface baked from it, replacing an existing one.

    Raises ``InputError`` if the map was retrained meanwhile.
    """
    return _save_part(folder, of, "surface", tensors_to_bytes(surface_tensors(surface)))


def save_landmarks(
    folder: Path, of: MapInfo, landmarks: LandmarkMap, colour_noise: float | None = None,
    source: LandmarkSource = "photos",
) -> MapInfo:  # fmt: skip
    """Add landmarks to map ``of``, replacing existing ones, and the field's errors measured on its images.

    ``source`` is the kind of images that the landmarks were built from. Raises ``InputError`` if the map was
    retrained meanwhile, and if the detector of the landmarks has no name by which a query could find it.
    """
    _check_features(landmarks, folder)
    content = tensors_to_bytes(landmark_tensors(landmarks))
    return _save_part(
        folder, of, "landmarks", content, colour_noise=colour_noise, landmark_source=source,
        landmark_features=landmarks.features,
    )  # fmt: skip


def save_capture(folder: Path, of: MapInfo, capture: CaptureReport) -> MapInfo:
    """Add the capture record of its photos to map ``of``, replacing an existing one.

    Raises ``InputError`` if the map was retrained meanwhile.
    """
    return _save_part(folder, of, "capture", _json(capture))


def _check_features(landmarks: LandmarkMap, folder: Path) -> None:
    if not landmarks.features:
        raise InputError("the landmarks' detector has no name;", where=folder, expected="a registered one")


def _save_part(folder: Path, of: MapInfo, part: str, content: bytes, **facts: Any) -> MapInfo:
    """Add a file to a map under the name of a part of its description."""
    info = load_info(folder)
    if info.weights != of.weights:
        raise InputError(f"was retrained while its {part} was built; bake it again", where=folder)
    name = _file_name(part, of.step)
    info = replace(info, **(facts | {part: name}))
    description = _json(info)
    try:
        write_file(folder / name, content)
        write_file(folder / DESCRIPTION, description)
    finally:
        _sweep(folder)
    return info


def content_digest(field: RadianceField, surface: SurfaceMap | None, landmarks: LandmarkMap | None) -> str:
    """Return a hexadecimal digest of a map's content."""
    trained = trained_field(field)
    parts = [packed(trained.state_dict())] if isinstance(trained, nn.Module) else []
    if isinstance(field, ScaledField):
        parts.append({"scale": torch.tensor(field.scale, dtype=torch.float64)})
    parts += [] if surface is None else [packed(surface_tensors(surface))]
    parts += [] if landmarks is None else [packed(landmark_tensors(landmarks))]
    hashed = hashlib.blake2b(digest_size=8)
    for part in parts:
        hashed.update(tensors_to_bytes(part))
    return hashed.hexdigest()


def load_state(folder: Path, info: MapInfo, field: RadianceField) -> TrainingState:
    """Return the state from which the interrupted training of ``field`` can be resumed."""
    if info.training is None:
        raise InputError(
            f"training is complete ({amount(info.step, 'step')}), nothing to resume", where=folder
        )
    path = folder / info.weights
    weights = checked_weights(trained_field(field), read_tensors(path, EXPECTED_PART), path)
    return TrainingState(info.step, weights, read_tensors(folder / info.training, EXPECTED_PART))


def load_surface(path: Path) -> SurfaceMap:
    """Load the baked surface of a map. Raises ``InputError`` if the file does not hold the tensors of one."""
    return load_part(path, surface_from_tensors, "a baked surface", BAKED)


def load_landmarks(folder: Path, info: MapInfo) -> LandmarkMap | None:
    """Load the landmarks of a map; None if it has none. Raises ``InputError`` if the file does not hold their tensors."""
    if info.landmarks is None:
        return None
    return with_images(load_part(folder / info.landmarks, landmarks_from_tensors, "landmarks", BAKED), info)


def with_images(landmarks: LandmarkMap, info: MapInfo) -> LandmarkMap:
    """Return the landmarks with what a map's description records about the images they were built from."""
    cameras = tuple(camera.intrinsics for camera in info.cameras)
    return replace(landmarks, cameras=cameras, features=info.landmark_features)


def load_capture(path: Path) -> CaptureReport:
    """Load a capture record. Raises ``InputError`` if the file does not hold one."""
    expected = "a capture record, which 'bidnerf bake' with --data can recreate"
    return from_plain(CaptureReport, read_json(path, expected), str(path))


@contextlib.contextmanager
def map_folder(out: Path, overwrite: bool) -> Iterator[None]:
    """Prepare a folder for a map, and hold its lock: see ``output_folder``."""
    with output_folder(out, overwrite, _is_leftover, _described):
        yield


def _is_leftover(file: Path) -> bool:
    """Return whether the file was left behind by a process that was killed before the map was complete."""
    return OURS.fullmatch(file.name) is not None and not (file.parent / DESCRIPTION).exists()


def _described(folder: Path) -> str | None:
    """Return what a folder holds, if it is a map whose training was interrupted."""
    try:
        stopped = load_info(folder).interruption
    except InputError:
        return None
    return None if stopped is None else f"holds a map, and {stopped}"


def _file_name(part: str, step: int) -> str:
    """Return a new name for a file of a map, which matches ``OURS``."""
    ending = "json" if part in ("capture", "anchor") else "safetensors"
    return f"{part}-{step:08d}-{secrets.token_hex(4)}.{ending}"


def _json(value: Any) -> bytes:
    return json.dumps(to_plain(value), indent=1, allow_nan=False).encode()


def _finish_anchor(folder: Path) -> set[str] | None:
    """Put the anchor that ``map.json`` names in place, and return all files that it names; None if it is damaged."""
    exists = os.path.lexists(folder / DESCRIPTION)
    try:
        found = read_json(folder / DESCRIPTION, "the description of a map") if exists else {}
        named = {name: found.get(name) for name in PART_NAMES}
    except (InputError, AttributeError):
        return None
    newer = named["anchor"]
    if isinstance(newer, str) and NEWER.fullmatch(newer):
        put_in_place(folder, newer)
    return {name for name in named.values() if isinstance(name, str)}


def _sweep(folder: Path) -> None:
    """Remove the files of earlier and interrupted saves that ``map.json`` does not name."""
    kept = _finish_anchor(folder)
    if kept is None:
        return
    for file in list(folder.iterdir()):
        if OURS.fullmatch(file.name) and file.name not in kept:
            with contextlib.suppress(OSError):  # a left-over file does no harm
                file.unlink()
