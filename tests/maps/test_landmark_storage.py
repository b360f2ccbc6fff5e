"""Landmarks on disk: what is saved is what is loaded, damaged files are named, and maps without them still open."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import save as tensors_to_bytes

import baked
import tiny
from bidnerf_core.errors import InputError
from bidnerf_core.io import to_plain, write_file
from bidnerf_core.mapping import LandmarkMap, build_landmarks, landmark_tensors
from bidnerf_core.maps import MapInfo, load_info, load_map, save_map
from bidnerf_core.maps.files import save_landmarks, save_surface
from bidnerf_core.scenes import demo_object
from bidnerf_core.training import TrainingState
from bidnerf_hashgrid import backend
from landmark_scene import Points, ring

BOUNDS = demo_object().bounds


@pytest.fixture(scope="module")
def landmarks() -> LandmarkMap:
    points = Points(count=60, noise=0.2)
    return replace(build_landmarks(ring(points, 5), points), features="points")


def saved(folder: Path, seed: int = 0) -> MapInfo:
    """Write a map without landmarks."""
    info = MapInfo("hashgrid", to_plain(tiny.config()), BOUNDS, step=5, complete=True)
    return save_map(
        folder, info, TrainingState(5, backend.build(tiny.config(seed=seed), BOUNDS).state_dict(), {})
    )


def names(folder: Path) -> set[str]:
    return {file.name for file in folder.iterdir()}


def assert_equal(found: LandmarkMap | None, expected: LandmarkMap) -> None:
    assert found is not None
    parts, others = landmark_tensors(found), landmark_tensors(expected)
    for name, value in others.items():
        assert parts[name].dtype == value.dtype
        assert torch.equal(parts[name], value), name


def test_landmarks_of_a_detector_without_a_name_are_not_stored(
    tmp_path: Path, landmarks: LandmarkMap
) -> None:
    with pytest.raises(InputError, match="detector has no name"):
        save_landmarks(tmp_path, saved(tmp_path), replace(landmarks, features=""))


def test_landmarks_come_back_as_they_were(landmarks: LandmarkMap, tmp_path: Path) -> None:
    info = save_landmarks(tmp_path, saved(tmp_path), landmarks, colour_noise=0.03125)
    loaded = load_map(tmp_path)
    assert loaded.info == info == load_info(tmp_path)
    assert loaded.colour_noise == 0.03125
    assert_equal(loaded.landmarks, landmarks)
    assert names(tmp_path) == {"map.json", info.weights, info.landmarks}
    assert load_map(tmp_path, baked=False).landmarks is None


def test_landmarks_and_surface_are_replaced_apart(landmarks: LandmarkMap, tmp_path: Path) -> None:
    save_landmarks(tmp_path, saved(tmp_path), landmarks)
    both = save_surface(tmp_path, load_info(tmp_path), baked.patch())
    few = landmarks[torch.arange(10)]
    again = save_landmarks(tmp_path, load_info(tmp_path), few)
    assert again.surface == both.surface
    assert again.landmarks != both.landmarks
    loaded = load_map(tmp_path)
    assert loaded.surface is not None
    assert_equal(loaded.landmarks, few)
    assert names(tmp_path) == {"map.json", again.weights, again.surface, again.landmarks}


def test_training_drops_landmarks_and_what_was_measured_of_the_field(
    landmarks: LandmarkMap, tmp_path: Path
) -> None:
    """Both belong to weights that are no more."""
    info = save_landmarks(tmp_path, saved(tmp_path), landmarks, colour_noise=0.1)
    trained = save_map(
        tmp_path, info, TrainingState(6, backend.build(tiny.config(), BOUNDS).state_dict(), {})
    )
    assert (trained.landmarks, trained.colour_noise) == (None, None)
    loaded = load_map(tmp_path)
    assert (loaded.landmarks, loaded.colour_noise) == (None, None)
    assert names(tmp_path) == {"map.json", trained.weights}


def test_landmarks_of_other_weights_are_refused(landmarks: LandmarkMap, tmp_path: Path) -> None:
    before, after = saved(tmp_path), saved(tmp_path)
    with pytest.raises(InputError, match="retrained while its landmarks"):
        save_landmarks(tmp_path, before, landmarks)
    assert load_info(tmp_path) == after


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"\x80\x04.", "expected a safetensors file"),
        (None, "no such file"),
        ({"positions": torch.ones(2, 3)}, "landmarks"),
        ({"noise": torch.tensor(-1.0, dtype=torch.float64)}, "noise is -1"),
        ({"positions": torch.full((2, 3), torch.nan)}, "NaN"),
    ],
    ids=["no tensors", "missing", "other tensors", "negative noise", "not a number"],
)
def test_damaged_landmarks_are_named(
    content: Any, said: str, landmarks: LandmarkMap, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    path = tmp_path / str(save_landmarks(tmp_path, saved(tmp_path), landmarks).landmarks)
    if content is None:
        path.unlink()
    elif isinstance(content, bytes):
        path.write_bytes(content)
    else:
        kept = {} if "other" in request.node.name else landmark_tensors(landmarks)
        write_file(path, tensors_to_bytes(kept | content))
    with pytest.raises(InputError, match=said) as told:
        load_map(tmp_path)
    assert str(path) in str(told.value)
    assert "\n" not in str(told.value)
    assert load_map(tmp_path, baked=False).landmarks is None
    save_landmarks(tmp_path, load_info(tmp_path), landmarks)  # which mends it
    assert_equal(load_map(tmp_path).landmarks, landmarks)


@pytest.mark.parametrize("name", ["../elsewhere.safetensors", ""])
def test_a_name_that_leads_out_of_the_folder_is_refused(
    name: str, landmarks: LandmarkMap, tmp_path: Path
) -> None:
    save_landmarks(tmp_path, saved(tmp_path), landmarks)
    path = tmp_path / "map.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"landmarks": name}))
    with pytest.raises(InputError, match="expected the name of a file next to it"):
        load_map(tmp_path)


def test_a_map_from_before_there_were_landmarks_still_opens(tmp_path: Path) -> None:
    """Its description has neither entry."""
    saved(tmp_path)
    path = tmp_path / "map.json"
    described = json.loads(path.read_text())
    for entry in ("landmarks", "colour_noise"):
        del described[entry]
    path.write_text(json.dumps(described))
    loaded = load_map(tmp_path)
    assert (loaded.landmarks, loaded.surface, loaded.colour_noise) == (None, None, None)
