"""The textured ground as a map that commands open as if it were stored, and a flight over it as a dataset."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from bidnerf import SE3, Frame, Intrinsics, Map, View, evaluation
from bidnerf.testing import textured_map
from bidnerf_core.captures import StoredCamera
from bidnerf_core.datasets import write_transforms
from bidnerf_core.mapping import LandmarkMap
from bidnerf_core.maps import MapInfo
from optional import require


def landmarks_of(*cameras: Intrinsics) -> LandmarkMap:
    """Return the landmarks of the ground, as if trial photos by these cameras had been localized in the map."""
    scatter = torch.full((4,), 0.001, dtype=torch.float64)
    return replace(require(textured_map().landmarks), cameras=cameras, calibration_scatter=scatter)


def open_ground(
    patch: pytest.MonkeyPatch,
    cameras: Sequence[StoredCamera] = (),
    assumed: tuple[Intrinsics, ...] = (),
    has_landmarks: bool = True,
) -> None:
    """Let commands open the ground, whatever folder they name. ``assumed``: the landmarks' cameras, if given."""
    known = textured_map(surface=True)
    landmarks = landmarks_of(*assumed) if assumed else known.landmarks
    info = MapInfo(
        "ground", {}, known.bounds, 1, True, "data", weights="ground", cameras=tuple(cameras), colour_noise=0.0
    )
    scene = Map(info, known.field, known.surface, landmarks if has_landmarks else None)
    for name in evaluation.__all__:  # which would otherwise be imported with what is patched, and keep it
        getattr(evaluation, name)
    patch.setattr("bidnerf_core.maps.read_description", lambda folder: {})
    patch.setattr("bidnerf_core.maps.load_map", lambda folder, device="cpu": scene)


def write_flight(folder: Path, frames: Sequence[tuple[Frame, SE3]]) -> Path:
    """Write frames and their poses as the test split of a dataset."""
    write_transforms(folder, {"test": [View(frame, T) for frame, T in frames]}, (0.0, 0.0, 0.0))
    return folder
