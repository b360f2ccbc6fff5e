"""A map on disk: a folder of JSON and safetensors, nothing that can run when it is read.

``map.json`` describes the map and names the files of its tensors. Files are written under new names first and
``map.json`` is replaced last, in one stroke: whenever the writing stops, the folder holds one whole map.
"""

from __future__ import annotations

import contextlib
import json
import os
import secrets
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load as tensors_from_bytes
from safetensors.torch import save as tensors_to_bytes
from torch import Tensor, nn

from bidnerf_core.backend import Backend
from bidnerf_core.camera import Intrinsics
from bidnerf_core.errors import InputError
from bidnerf_core.field import RadianceField, SceneBounds
from bidnerf_core.frames import View
from bidnerf_core.plain import from_plain, to_plain
from bidnerf_core.registry import load_backend
from bidnerf_core.training import TrainingState

FORMAT = "bidnerf map"
VERSION = 1
DESCRIPTION = "map.json"


@dataclass(frozen=True)
class StoredCamera:
    """Where a training image was taken: poses that are known to see the scene."""

    name: str
    intrinsics: Intrinsics
    T_world_camera: tuple[tuple[float, float, float, float], ...]  # 4x4, rows


@dataclass(frozen=True)
class MapInfo:
    """What ``map.json`` holds."""

    backend: str
    config: dict[str, Any]
    bounds: SceneBounds
    step: int  # training steps done
    complete: bool  # whether training came to its end
    data: str = ""  # name of the dataset's folder
    seconds: float = 0.0  # of training
    cameras: tuple[StoredCamera, ...] = ()
    weights: str = ""  # file names
    training: str | None = None  # what resuming needs; dropped when training is complete
    bidnerf: str = field(default_factory=lambda: version("bidnerf"))
    format: str = FORMAT
    version: int = VERSION


@dataclass(frozen=True, eq=False)
class Map:
    """A stored map, ready for use: its field is frozen (no parameter requires a gradient)."""

    info: MapInfo
    field: RadianceField

    @property
    def bounds(self) -> SceneBounds:
        return self.info.bounds


def stored_cameras(views: Sequence[View]) -> tuple[StoredCamera, ...]:
    return tuple(
        StoredCamera(
            v.frame.name, v.frame.intrinsics, tuple(tuple(r) for r in v.T_ref_camera.matrix().tolist())
        )
        for v in views
    )


def build_field(backend: Backend, info: MapInfo, where: str) -> tuple[RadianceField, Any]:
    """An untrained field and its config, as ``info`` describes them."""
    config: Any = from_plain(backend.config_type, info.config, f"{where}: config")
    return backend.build(config, info.bounds), config


def save_map(folder: Path, info: MapInfo, state: TrainingState) -> MapInfo:
    """Write one whole map; what an earlier save left is removed once the new one stands."""
    folder.mkdir(parents=True, exist_ok=True)
    name = f"{state.step:08d}-{secrets.token_hex(4)}.safetensors"
    info = replace(info, weights=f"weights-{name}", training=None if info.complete else f"training-{name}")
    _write(folder / info.weights, tensors_to_bytes(_packed(state.field)))
    if info.training is not None:
        _write(folder / info.training, tensors_to_bytes(_packed(state.optimizer)))
    _write(folder / DESCRIPTION, json.dumps(to_plain(info), indent=1, allow_nan=False).encode())
    for other in folder.glob("*-*.safetensors"):
        if other.name not in (info.weights, info.training) and other.name.startswith(
            ("weights-", "training-")
        ):
            other.unlink()
    return info


def load_info(folder: Path) -> MapInfo:
    """Read and judge ``map.json``. Raises ``InputError`` where it is no map, or one of another version."""
    path = folder / DESCRIPTION
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder, expected a map as written by 'bidnerf train'")
    if not path.is_file():
        raise InputError(f"{folder}: no {DESCRIPTION} in it, expected a map as written by 'bidnerf train'")
    try:
        found = json.loads(path.read_bytes())
    except ValueError as error:
        raise InputError(f"{path}: not JSON ({error}), expected the description of a map") from error
    if not isinstance(found, dict) or found.get("format") != FORMAT:
        raise InputError(f'{path}: not the description of a map, expected "format": "{FORMAT}"')
    if found.get("version") != VERSION:
        raise InputError(f"{path}: version {found.get('version')!r}, expected {VERSION}; train the map anew")
    return from_plain(MapInfo, found, str(path))


def load_map(folder: Path, device: torch.device | str = "cpu") -> Map:
    """The map in ``folder``, its field built by its backend and frozen."""
    info = load_info(folder)
    field, _ = build_field(load_backend(info.backend), info, str(folder / DESCRIPTION))
    if not isinstance(field, nn.Module):
        raise InputError(
            f"{folder}: backend {info.backend!r} built a {type(field).__name__}, expected an nn.Module"
        )
    _fill(field, read_tensors(folder / info.weights), folder / info.weights)
    field.requires_grad_(False).eval().to(device)
    return Map(info, field)


def load_state(folder: Path, info: MapInfo) -> TrainingState:
    """What an interrupted training needs to go on."""
    if info.training is None:
        raise InputError(f"{folder}: training is complete ({info.step} steps), nothing to resume")
    return TrainingState(info.step, read_tensors(folder / info.weights), read_tensors(folder / info.training))


def read_tensors(path: Path) -> dict[str, Tensor]:
    try:
        return tensors_from_bytes(path.read_bytes())
    except FileNotFoundError as error:
        raise InputError(
            f"{path}: no such file, but {DESCRIPTION} names it; the map is incomplete"
        ) from error
    except SafetensorError as error:
        raise InputError(f"{path}: not readable ({error}), expected a safetensors file") from error


def _fill(field: nn.Module, tensors: dict[str, Tensor], path: Path) -> None:
    """Load weights, comparing names and shapes first: torch's own message would run over many lines."""
    expected = field.state_dict()
    for name, value in expected.items():
        if name not in tensors:
            raise InputError(f"{path}: no tensor {name!r}, expected one of shape {list(value.shape)}")
        if tensors[name].shape != value.shape:
            found, wanted = list(tensors[name].shape), list(value.shape)
            raise InputError(f"{path}: tensor {name!r} has shape {found}, expected {wanted}")
    surplus = sorted(tensors.keys() - expected.keys())
    if surplus:
        raise InputError(
            f"{path}: tensor {surplus[0]!r} is not part of the field that {DESCRIPTION} describes"
        )
    field.load_state_dict(tensors)


def _packed(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """Contiguous and unshared, as safetensors wants them."""
    return {name: value.detach().cpu().contiguous().clone() for name, value in tensors.items()}


def _write(path: Path, content: bytes) -> None:
    """All of it or nothing, and on the disk before it has its name."""
    beside = path.with_name(f".{path.name}.{secrets.token_hex(4)}")
    try:
        with beside.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        beside.replace(path)
    except BaseException:
        with contextlib.suppress(OSError):
            beside.unlink()
        raise
