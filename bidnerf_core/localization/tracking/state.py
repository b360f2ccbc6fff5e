"""The state of a tracker between two frames, and the file that it can be kept in."""

from __future__ import annotations

import json
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save as tensors_to_bytes
from torch import Tensor

from bidnerf_core.errors import InputError
from bidnerf_core.geometry.se3 import SE3
from bidnerf_core.io.files import write_file
from bidnerf_core.io.json import parse_json
from bidnerf_core.io.tensors import read_tensors_and_metadata
from bidnerf_core.localization.search.miscalibration import Miscalibration
from bidnerf_core.localization.tracking.clock import Clock
from bidnerf_core.localization.tracking.corrected_camera import CorrectedCamera
from bidnerf_core.localization.tracking.flow import Grey
from bidnerf_core.localization.tracking.motion import Motion
from bidnerf_core.localization.tracking.points import FollowedPoints

STATE_FORMAT, STATE_VERSION = "bidnerf tracker", 5


@dataclass(frozen=True, eq=False)
class TrackerState:
    """All that a tracker carries from one frame to the next."""

    clock: Clock
    motion: Motion | None = None  # None before the first pose was found
    frames: int = 0  # number of frames that the tracker has been called with
    lost: int = 0  # consecutive frames without an accepted pose, up to the last one
    searchable: int = 0  # of these, the frames that could be searched
    waited: float = 0.0  # seconds since the loss, or since the last search of an image
    points: FollowedPoints = field(default_factory=FollowedPoints.none)
    image: Grey | None = None  # the last one, in which the points were seen
    sought: int = 0  # number of points when they were last sought
    age: int = 0  # frames since then
    usual_distance: float = float("inf")  # largest squared distance between the descriptors of a match
    miscalibration: Miscalibration = field(default_factory=Miscalibration.unknown)
    calibrated: int | None = None  # the frame (of ``frames``) in which the intrinsics were last checked
    camera: CorrectedCamera | None = None  # found by searches; None while the given intrinsics are taken
    noise: float = 1.0  # pixels: of the points in the last image

    @property
    def tracking(self) -> bool:
        """Whether the pose of the last frame was accepted."""
        return self.motion is not None and self.lost == 0


def save_state(path: Path, state: TrackerState, key: str) -> None:
    """Write a state as safetensors, atomically; ``key`` identifies the map."""
    numbers = {
        "now": state.clock.now, "interval": state.clock.interval, "frames": state.frames, "lost": state.lost,
        "sought": state.sought, "age": state.age, "usual_distance": _written(state.usual_distance),
        "noise": state.noise,
        "reach": None if state.motion is None else state.motion.reach,
        "agility": None if state.motion is None else state.motion.agility, "searchable": state.searchable,
        "waited": state.waited,
        "calibrated": state.calibrated, "camera": None if state.camera is None else state.camera.plain(),
    }  # fmt: skip
    tensors = {f"points.{f.name}": getattr(state.points, f.name) for f in fields(FollowedPoints)}
    tensors |= {
        f"miscalibration.{f.name}": getattr(state.miscalibration, f.name) for f in fields(Miscalibration)
    }
    if state.image is not None:
        tensors["image"] = torch.from_numpy(state.image)
    if state.motion is not None:
        tensors |= _pose_tensors("motion", state.motion.T_world_camera)
        tensors |= {f"motion.{name}": getattr(state.motion, name) for name in ("velocity", "noise", "bias")}
    content = {"format": STATE_FORMAT, "version": STATE_VERSION, "map": key, "state": numbers}
    metadata = {"bidnerf": json.dumps(content, allow_nan=False)}
    write_file(
        path,
        tensors_to_bytes({name: value.contiguous().clone() for name, value in tensors.items()}, metadata),
    )


def load_tracker_state(path: Path, key: str) -> TrackerState:
    """Read a state. Raises ``InputError`` for another file, another version, and another map than ``key``."""
    numbers, tensors = _read(path, key)
    try:
        return _state(numbers, tensors)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: not a whole state of a tracker ({error}), save it anew") from error


def _read(path: Path, key: str) -> tuple[dict[str, Any], dict[str, Tensor]]:
    expected = "a file that Tracker.save wrote"
    tensors, metadata = read_tensors_and_metadata(path, expected)
    found = parse_json(metadata.get("bidnerf", "null"), str(path), expected)
    if not isinstance(found, dict) or found.get("format") != STATE_FORMAT:
        raise InputError(f"{path}: not the state of a tracker, expected {expected}")
    if found.get("version") != STATE_VERSION:
        raise InputError(
            f"{path}: version {found.get('version')!r}, expected {STATE_VERSION}; begin the sequence anew"
        )
    if found.get("map") != key:
        raise InputError(f"{path}: belongs to map {found.get('map')!r}, the tracker's is {key!r}")
    return found["state"], tensors


def _state(numbers: dict[str, Any], tensors: dict[str, Tensor]) -> TrackerState:
    motion = None
    if numbers["reach"] is not None:
        velocity, noise, bias = (tensors[f"motion.{name}"] for name in ("velocity", "noise", "bias"))
        motion = Motion(_pose("motion", tensors), velocity, noise, bias, numbers["reach"], numbers["agility"])
    points = FollowedPoints(*(tensors[f"points.{f.name}"] for f in fields(FollowedPoints)))
    usual = numbers["usual_distance"]
    miscalibration = Miscalibration(*(tensors[f"miscalibration.{f.name}"] for f in fields(Miscalibration)))
    return TrackerState(
        Clock(numbers["now"], numbers["interval"]), motion, numbers["frames"], numbers["lost"],
        numbers["searchable"], numbers["waited"], points,
        tensors["image"].numpy() if "image" in tensors else None, numbers["sought"], numbers["age"],
        float("inf") if usual is None else usual, miscalibration, numbers["calibrated"],
        None if numbers["camera"] is None else CorrectedCamera.from_plain(numbers["camera"]), numbers["noise"],
    )  # fmt: skip


def _written(number: float) -> float | None:
    return None if number == float("inf") else number


def _pose_tensors(name: str, T: SE3) -> dict[str, Tensor]:
    return {f"{name}.rotation": T.rotation, f"{name}.translation": T.translation}


def _pose(name: str, tensors: dict[str, Tensor]) -> SE3:
    return SE3(tensors[f"{name}.rotation"], tensors[f"{name}.translation"])
