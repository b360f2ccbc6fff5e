"""The file format of a tracker's state."""

from __future__ import annotations

import json
from pathlib import Path

import torch
from safetensors.torch import save as tensors_to_bytes
from torch import Tensor

from bidnerf_core.errors import InputError
from bidnerf_core.io import (
    TensorKind,
    check_tensors,
    from_plain,
    pack_tensors,
    parse_json,
    read_tensors_and_metadata,
    to_plain,
    with_tensors,
    write_file,
)
from bidnerf_core.localization import TrackerState
from bidnerf_core.settings import LARGEST_LENGTH

STATE_FORMAT, STATE_VERSION = "bidnerf tracker", 11
STATE_KINDS = {
    name: TensorKind(shape, dtype, least, LARGEST_LENGTH)
    for name, shape, dtype, least in (
        ("points.pixels", "m 2", torch.float32, -LARGEST_LENGTH),
        ("points.positions", "m 3", torch.float64, -LARGEST_LENGTH),
        ("points.deviations", "m 2", torch.float64, 0),
        ("points.directions", "m 3", torch.float64, -LARGEST_LENGTH),
        ("points.landmark", "m", torch.int64, -1),
        ("motion.T_world_camera.rotation", "3 3", torch.float64, -LARGEST_LENGTH),
        ("motion.T_world_camera.translation", "3", torch.float64, -LARGEST_LENGTH),
        ("motion.velocity", "6", torch.float64, -LARGEST_LENGTH),
        ("motion.noise", "12 12", torch.float64, -LARGEST_LENGTH),
        ("motion.bias", "6 6", torch.float64, -LARGEST_LENGTH),
        ("camera", "6", torch.float64, -LARGEST_LENGTH),
        ("doubt", "6 6", torch.float64, -LARGEST_LENGTH),
    )
}
"""The tensors of a state; without a motion, those of the motion are absent."""


def save_state(path: Path, state: TrackerState, key: str) -> None:
    """Write a state as safetensors, atomically; ``key`` identifies the map."""
    tensors: dict[str, Tensor] = {}
    content = {
        "format": STATE_FORMAT,
        "version": STATE_VERSION,
        "map": key,
        "state": to_plain(state, tensors=tensors),
    }
    write_file(path, tensors_to_bytes(pack_tensors(tensors), {"bidnerf": json.dumps(content, allow_nan=False)}))


def load_tracker_state(path: Path, key: str) -> TrackerState:
    """Read a state. Raises ``InputError`` for any other file, for another version, and for the state of a map other than ``key``."""
    expected = "a file written by Tracker.save"
    tensors, metadata = read_tensors_and_metadata(path, expected)
    found = parse_json(metadata.get("bidnerf", "null"), str(path), expected)
    if not isinstance(found, dict) or found.get("format") != STATE_FORMAT:
        raise InputError("not the state of a tracker", where=path, expected=expected)
    if found.get("version") != STATE_VERSION:
        raise InputError(
            f"version {found.get('version')!r}", where=path, expected=f"{STATE_VERSION}; begin the sequence anew"
        )
    if found.get("map") != key:
        raise InputError(f"belongs to map {found.get('map')!r}, the tracker's is {key!r}", where=path)
    state = from_plain(TrackerState, with_tensors(found.get("state"), tensors, str(path)), str(path))
    try:
        check_tensors(tensors, {name: kind for name, kind in STATE_KINDS.items() if name in tensors})
    except ValueError as error:
        raise InputError(str(error), where=path, expected=expected) from error
    motion, counts = state.motion, (state.frames, state.lost, state.searchable, state.sought, state.age)
    is_sound = min(counts) >= 0 and state.clock.interval > 0
    if motion is not None:
        variances = torch.cat([motion.noise.diagonal(), motion.bias.diagonal()])
        is_sound &= bool((variances >= 0).all() & motion.T_world_camera.is_rigid())
        is_sound &= 0 < motion.reach <= LARGEST_LENGTH
    if not is_sound:
        raise InputError("the numbers are impossible", where=path, expected=expected)
    return state
