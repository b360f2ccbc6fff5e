"""Maps on disk: what is saved is what is loaded, and what is damaged is named."""

from __future__ import annotations

import functools
import itertools
import json
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.torch import save as tensors_to_bytes
from torch import Tensor, nn

import baked
import tiny
from balls import HomogeneousBall
from bidnerf_core.backend import load_backend
from bidnerf_core.captures import CaptureReport, CoverageRecord, PoseRefinement, StoredCamera, stored_cameras
from bidnerf_core.errors import InputError, InputWarning
from bidnerf_core.fields import SceneBounds
from bidnerf_core.geometry import SE3
from bidnerf_core.io import to_plain, write_file
from bidnerf_core.mapping import LandmarkMap, build_landmarks, landmark_tensors, surface_tensors

# Inside: single parts of a map are saved, damaged and read again
from bidnerf_core.maps import (
    Anchor,
    Map,
    MapInfo,
    load_info,
    load_map,
    read_part,
    store,
    write_parts,
)
from bidnerf_core.maps.description import FieldFrame
from bidnerf_core.maps.store import load_state
from bidnerf_core.training import TrainingState
from bidnerf_hashgrid import HashGridField, backend
from commands import Run
from drawn import poses, record, shares
from interruptions import FULL, striking
from landmark_scene import Points, ring
from optional import require
from refusals import refused
from trainings import assert_same_tensors

BOUNDS = SceneBounds((-0.1, -1 / 3, -1.0), (1.0, 2 / 3, 1e-17), 0.1, 5.0, (1.0, 0.5, 0.0))


CAMERAS = stored_cameras(tiny.views(2))


def info(step: int = 5, complete: bool = False) -> MapInfo:
    return MapInfo("hashgrid", to_plain(tiny.config()), BOUNDS, step, complete, "data", 1 / 3, CAMERAS)


def field(seed: int) -> HashGridField:
    """No two values alike, and an occupancy that no training would give."""
    made = backend.build(tiny.config(seed=seed), BOUNDS)
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for value in made.state_dict().values():
            value.copy_(
                torch.rand(value.shape, generator=generator) > 0.5
                if value.dtype == torch.bool
                else torch.randn(value.shape, generator=generator)
            )
    return made


@functools.cache
def state(step: int = 5) -> TrainingState:
    """Another one for each step."""
    moments = {
        "generator": torch.Generator().manual_seed(step).get_state(),
        "0.step": torch.tensor(float(step)),
    }
    return TrainingState(step, field(step).state_dict(), moments)


def assert_holds(loaded: Map, expected: TrainingState) -> None:
    assert isinstance(loaded.field, nn.Module)
    assert_same_tensors(loaded.field.state_dict(), expected.field)


def names(folder: Path) -> set[str]:
    return {file.name for file in folder.iterdir()}


def described(folder: Path, **changes: Any) -> None:
    """Write a map whose description has these entries."""
    write_parts(folder, info(), state())
    path = folder / "map.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


def test_backends_are_imported_where_tensors_have_values(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Shapes are checked on a device without values, on which the constants of a module would have none."""
    devices = list[str]()

    def load(name: str, wanted_by: str = "") -> Any:
        devices.append(torch.zeros(1).device.type)
        return load_backend(name, wanted_by)

    monkeypatch.setattr("bidnerf_core.maps.store.load_backend", load)
    write_parts(tmp_path, info(), state())
    load_map(tmp_path)
    assert devices[0] == "cpu"


@pytest.mark.parametrize("complete", [True, False])
def test_what_is_saved_is_what_is_loaded(complete: bool, tmp_path: Path) -> None:
    saved = write_parts(tmp_path / "a" / "map", info(complete=complete), state())
    assert replace(saved, weights="", training=None) == info(complete=complete)
    suffixes = {file.suffix for file in (tmp_path / "a" / "map").iterdir()}
    assert suffixes == {".json", ".safetensors"}, "nothing on disk can run"
    loaded = load_map(tmp_path / "a" / "map")
    assert loaded.info == saved
    assert loaded.bounds == BOUNDS
    assert_holds(loaded, state())
    assert isinstance(loaded.field, nn.Module)
    assert not any(parameter.requires_grad for parameter in loaded.field.parameters())
    assert not loaded.field.training
    if complete:
        with refused(where=tmp_path / "a" / "map", found="training is complete (5 steps)"):
            load_state(tmp_path / "a" / "map", saved, field(1))
    else:
        resumed = load_state(tmp_path / "a" / "map", saved, field(1))
        assert resumed.step == 5
        assert_same_tensors(resumed.field, state().field)
        assert_same_tensors(resumed.optimizer, state().optimizer)


rows = poses().map(lambda T: tuple(map(tuple, T.matrix().tolist())))
descriptions = record(
    MapInfo,
    cameras=st.lists(record(StoredCamera, T_world_camera=rows, given_T_world_camera=st.none() | rows), max_size=2).map(
        tuple
    ),
    pose_refinement=st.none() | record(PoseRefinement, noise_before=shares, noise_after=shares),
    anchor=st.none()
    | record(
        Anchor,
        latitude=st.floats(-89, 89),
        longitude=st.floats(-180, 180),
        metres_per_unit=st.floats(1e-3, 1e3),
        T_enu_world=rows,
        position_sigma=shares,
        orientation_sigma=shares,
    ),
    field_frame=st.none() | record(FieldFrame, scale=st.floats(1e-3, 1e3)),
    **{name: st.just(getattr(info(), name)) for name in ("landmark_source", "colour_noise", "format", "version")},
)


@settings(max_examples=20)
@given(given_info=descriptions)
def test_any_description_comes_back_as_it_was(given_info: MapInfo, tmp_path: Path) -> None:
    saved = write_parts(tmp_path, given_info, TrainingState(5, {"w": torch.ones(1)}, {}))
    assert load_info(tmp_path) == saved
    parts = ("weights", "training", "surface", "landmarks", "capture")
    assert replace(saved, **{p: getattr(given_info, p) for p in parts}) == given_info


def test_views_of_shared_or_strided_memory_are_saved(tmp_path: Path) -> None:
    tensors = dict(state().field)
    weight = tensors["geometry.0.weight"]
    tensors["geometry.0.weight"] = weight.t().contiguous().t()
    write_parts(tmp_path, info(), TrainingState(5, tensors, {}))
    assert_holds(load_map(tmp_path), state())


def test_old_files_are_removed_and_others_are_left_alone(tmp_path: Path) -> None:
    mine = ["weights-best.safetensors", "training-00000001-aaaaaaaa.txt", ".map.json.swp", "notes"]
    stray = [
        ".weights-00000004-0a1b2c3d.safetensors.0a1b2c3d",
        ".map.json.0a1b2c3d",
        "training-00000004-0a1b2c3d.safetensors",
    ]
    for name in (*mine, *stray):
        (tmp_path / name).touch()
    write_parts(tmp_path, info(step=5), state(5))
    saved = write_parts(tmp_path, info(step=6), state(6))
    assert names(tmp_path) == {*mine, "map.json", saved.weights, require(saved.training)}
    done = write_parts(tmp_path, info(step=7, complete=True), state(7))
    assert names(tmp_path) == {*mine, "map.json", done.weights}


@pytest.mark.parametrize("times", [1, 100])
def test_a_map_that_a_training_replaces_while_it_is_read(
    times: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Between the description and the weights, the next checkpoint comes, once or each time."""
    write_parts(tmp_path, info(step=5), state(5))
    read, steps = store.read_tensors, iter(range(6, 6 + times))

    def late(path: Path, expected: str) -> dict[str, Tensor]:
        for step in itertools.islice(steps, 1):
            write_parts(tmp_path, info(step=step), state(5))
        return read(path, expected)

    monkeypatch.setattr(store, "read_tensors", late)
    if times > 1:
        with refused(where=tmp_path, found="replaced faster than it can be read"):
            load_map(tmp_path)
    else:
        loaded = load_map(tmp_path)
        assert loaded.info.step == 6
        assert_holds(loaded, state(5))


def test_a_damaged_description_makes_no_save_remove_anything(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_parts(tmp_path, info(step=5), state(5))
    (tmp_path / "map.json").write_text("{")
    before = names(tmp_path)
    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", striking(Path.replace, [], 0, FULL))
        with pytest.raises(OSError, match="No space left"):
            write_parts(tmp_path, info(step=6), state(6))
    assert names(tmp_path) == before


def test_what_json_cannot_hold_is_told_before_anything_is_written(tmp_path: Path) -> None:
    with refused(found="config.learning_rate is nan", expected="a finite number"):
        write_parts(tmp_path / "map", replace(info(), config={"learning_rate": float("nan")}), state())
    assert not (tmp_path / "map").exists()


# What a backend builds is judged as well.


def test_a_backend_that_builds_something_else_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_parts(tmp_path, info(), state())
    chosen = load_backend("hashgrid")
    monkeypatch.setattr(type(chosen), "build", lambda *_: HomogeneousBall(1.0, 1.0))
    with refused(where=tmp_path / "map.json", found="'hashgrid' built a HomogeneousBall", expected="an nn.Module"):
        load_map(tmp_path)


# The parts beside the weights that they were made from.


@functools.cache
def landmarks() -> LandmarkMap:
    points = Points(count=60, noise=0.2)
    return replace(build_landmarks(ring(points, 5), points), features="points")


def plain(part: Any) -> Any:
    """What is compared of a part."""
    if isinstance(part, CaptureReport):
        return part
    tensors = landmark_tensors(part) if isinstance(part, LandmarkMap) else surface_tensors(part)
    return {name: (value.dtype, value.tolist()) for name, value in tensors.items()}


PARTS: dict[str, Callable[[], tuple[Any, Any]]] = {
    "surface": lambda: (baked.patch(), baked.patch(3)),
    "landmarks": lambda: (landmarks(), landmarks()[torch.arange(10)]),
    "capture": lambda: (CaptureReport((), CoverageRecord(landmarks=7)), CaptureReport((), CoverageRecord())),
}
"""Two contents of each part that is added to a map."""


def save_part(folder: Path, known: MapInfo, name: str, number: int = 0) -> MapInfo:
    return write_parts(folder, known, **{name: PARTS[name]()[number]})


every_part = pytest.mark.parametrize("name", PARTS)


def with_part(folder: Path, name: str, complete: bool = True) -> tuple[MapInfo, Path]:
    """Write a map with a part; return its description and the path of the part."""
    saved = save_part(folder, write_parts(folder, info(complete=complete), state()), name)
    return saved, folder / getattr(saved, name)


@every_part
def test_a_part_comes_back_as_it_was_and_the_rest_of_the_map_stays(name: str, tmp_path: Path) -> None:
    saved, path = with_part(tmp_path, name, complete=False)
    loaded = load_map(tmp_path)
    assert loaded.info == saved == load_info(tmp_path)
    assert plain(getattr(loaded, name)) == plain(PARTS[name]()[0])
    assert name == "capture" or getattr(load_map(tmp_path, baked=False), name) is None
    assert_holds(loaded, state())
    assert names(tmp_path) == {"map.json", saved.weights, saved.training, path.name}


@settings(max_examples=20)
@given(capture=record(CaptureReport))
def test_any_capture_record_comes_back_as_it_was(capture: CaptureReport, tmp_path: Path) -> None:
    saved = write_parts(tmp_path, info(), TrainingState(5, {"w": torch.ones(1)}, {}), capture=capture)
    assert read_part(tmp_path, saved, "capture") == capture


@every_part
def test_a_new_part_replaces_the_old_one_alone_and_training_drops_it(name: str, tmp_path: Path) -> None:
    others = [other for other in PARTS if other != name]
    with_part(tmp_path, name)
    for other in others:
        save_part(tmp_path, load_info(tmp_path), other)
    before = load_info(tmp_path)
    after = save_part(tmp_path, before, name, 1)
    assert getattr(after, name) != getattr(before, name)
    assert replace(after, **{name: getattr(before, name)}) == before
    loaded = load_map(tmp_path)
    for each in PARTS:
        assert plain(getattr(loaded, each)) == plain(PARTS[each]()[int(each == name)])
    assert names(tmp_path) == {"map.json", after.weights, after.surface, after.landmarks, after.capture}
    trained = write_parts(tmp_path, after, state(6))
    assert [getattr(trained, each) for each in PARTS] == [None] * 3
    assert [getattr(load_map(tmp_path), each) for each in PARTS] == [None] * 3
    assert names(tmp_path) == {"map.json", trained.weights}


def test_what_was_measured_of_the_field_is_stored_with_landmarks_and_dropped_by_training(
    tmp_path: Path,
) -> None:
    saved = write_parts(tmp_path, info(complete=True), state())
    found = write_parts(tmp_path, replace(saved, colour_noise=0.03125), landmarks=landmarks())
    assert load_map(tmp_path).colour_noise == 0.03125
    assert write_parts(tmp_path, found, state(6)).colour_noise is None
    assert load_map(tmp_path).colour_noise is None


@every_part
def test_a_part_of_other_weights_is_refused(name: str, tmp_path: Path) -> None:
    before, after = (write_parts(tmp_path, info(complete=True), state()) for _ in range(2))
    with refused(where=tmp_path, found=f"retrained while its {name}"):
        save_part(tmp_path, before, name)
    assert load_info(tmp_path) == after
    assert names(tmp_path) == {"map.json", after.weights}


def test_landmarks_of_a_detector_without_a_name_are_not_stored(tmp_path: Path) -> None:
    saved = write_parts(tmp_path, info(complete=True), state())
    with refused(where=tmp_path, found="detector has no name", expected="a registered one"):
        write_parts(tmp_path, saved, landmarks=replace(landmarks(), features=""))


DAMAGES: dict[str, tuple[Callable[[Path], object], str]] = {
    "no tensors": (lambda path: path.write_bytes(b"\x80\x04."), "not "),
    "missing": (lambda path: None, "no such file"),
    "a pipe": (os.mkfifo, "is a named pipe"),
    "a device": (lambda path: path.symlink_to("/dev/zero"), "is a device"),
    "a folder": (Path.mkdir, "is a folder"),
}


@every_part
@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_part_is_named_and_can_be_made_anew(damage: str, name: str, tmp_path: Path) -> None:
    make, found = DAMAGES[damage]
    _, path = with_part(tmp_path, name)
    path.unlink()
    make(path)
    with refused(where=path, found=found, expected="which 'bidnerf bake'"):
        getattr(load_map(tmp_path), name)
    assert load_map(tmp_path, baked=False).surface is None
    save_part(tmp_path, load_info(tmp_path), name)
    assert getattr(load_map(tmp_path), name) is not None


@pytest.mark.parametrize(
    ("name", "tensors", "found"),
    [
        ("surface", {"rgb": torch.ones(2, 3)}, "not a baked surface (no tensor 'positions')"),
        ("landmarks", {"positions": torch.ones(2, 3)}, "not landmarks (no tensor 'deviations')"),
        (
            "landmarks",
            landmark_tensors(landmarks()) | {"noise": torch.tensor(-1.0).double()},
            "noise is -1, expected a positive number",
        ),
        (
            "landmarks",
            landmark_tensors(landmarks()) | {"positions": torch.full((2, 3), torch.nan)},
            "positions holds NaN",
        ),
    ],
    ids=["other surface", "other landmarks", "negative noise", "not a number"],
)
def test_a_part_of_other_tensors_is_named(name: str, tensors: dict[str, Tensor], found: str, tmp_path: Path) -> None:
    _, path = with_part(tmp_path, name)
    path.write_bytes(tensors_to_bytes(tensors))
    with refused(where=path, found=found, expected="which 'bidnerf bake' can recreate"):
        load_map(tmp_path)


@pytest.mark.parametrize("name", ["../elsewhere.safetensors", ""])
def test_a_name_that_leads_out_of_the_folder_is_refused(name: str, tmp_path: Path) -> None:
    for part in (*PARTS, "weights", "training"):
        described(tmp_path, **{part: name})
        with refused(where=tmp_path / "map.json", found=f"names {name!r}", expected="the name of a file next to it"):
            load_map(tmp_path)


def test_a_map_from_before_there_were_landmarks_still_opens(tmp_path: Path) -> None:
    """Its description has neither entry."""
    write_parts(tmp_path, info(), state())
    path = tmp_path / "map.json"
    entries = json.loads(path.read_text())
    path.write_text(json.dumps({k: v for k, v in entries.items() if k not in ("landmarks", "colour_noise")}))
    loaded = load_map(tmp_path)
    assert (loaded.landmarks, loaded.surface, loaded.colour_noise) == (None, None, None)


# Values that no training gives.


@pytest.mark.parametrize(
    ("name", "change", "found", "expected"),
    [
        ("occupancy.peak", lambda value: value.int(), "has dtype int32", None),
        ("colour.0.bias", lambda value: value.int(), "has dtype int32", None),
        ("occupancy.peak", lambda value: value * torch.nan, "holds NaN", None),
        ("colour.0.bias", lambda value: value * torch.nan, "holds NaN", None),
        ("colour.0.bias", lambda value: torch.full_like(value, -1e30), "", "trained weights"),
        ("colour.0.bias", lambda value: torch.full_like(value, 3e38), "", "trained weights"),
        ("colour.0.bias", lambda value: torch.full_like(value, -torch.inf), "", "trained weights"),
    ],
)
def test_weights_and_buffers_that_no_training_gives_are_refused(
    name: str, change: Callable[[Tensor], Tensor], found: str, expected: str | None, tmp_path: Path
) -> None:
    path = tmp_path / write_parts(tmp_path, info(complete=True), state()).weights
    write_file(path, tensors_to_bytes(dict(state().field) | {name: change(state().field[name])}))
    with refused(where=path, found=f"tensor {name!r} {found}".strip(), expected=expected) as caught:
        load_map(tmp_path)
    assert expected or "inf" not in caught.error.found


PLAIN = json.loads(json.dumps(to_plain(info())))
EYE = torch.eye(4).tolist()


@pytest.mark.parametrize(
    ("changes", "culprit", "value"),
    [
        ({"cameras": [PLAIN["cameras"][0] | {"T_world_camera": [[2.0, 0.0, 0.0, 0.0], *EYE[1:]]}]}, "camera", "rigid"),
        ({"cameras": [PLAIN["cameras"][0] | {"T_world_camera": EYE[:3]}]}, "camera", "rigid"),
        ({"bounds": PLAIN["bounds"] | {"far": 1e308}}, "bounds", "1e+308"),
        ({"bounds": PLAIN["bounds"] | {"far": 1e16}}, "bounds", "1e+16"),
        (
            {"pose_refinement": {"noise_before": 1e308, "noise_after": 0.3, "refined": False}},
            "pose_refinement",
            "1e+308",
        ),
        ({"field_frame": {"scale": 0.0, "bounds": PLAIN["bounds"]}}, "field_frame", "0.0"),
        ({"field_frame": {"scale": 1e30, "bounds": PLAIN["bounds"]}}, "field_frame: scale", "1e+30"),
        (
            {"cameras": [PLAIN["cameras"][0] | {"T_world_camera": [[1.0, 0.0, 0.0, 1e30], *EYE[1:]]}]},
            "camera",
            "at most 1e+15 from the origin",
        ),
        ({"cameras": [PLAIN["cameras"][0] | {"T_world_camera": [*EYE[:3], [0.0, 0.0, 0.0, 1e30]]}]}, "camera", "rigid"),
        ({"cameras": [PLAIN["cameras"][0] | {"moved_pixels": -1.0}]}, "moved_pixels", "0 to 1,000,000"),
        ({"cameras": [PLAIN["cameras"][0] | {"motion": [1e30, 0.0, 0.0, 0.0, 0.0, 0.0]}]}, "motion", "1e+30"),
        ({"origin": [0.0, 1e30, 0.0]}, "origin", "1e+30"),
        ({"gravity_up": [0.0, 1e30, 0.0]}, "gravity_up", "1e+30"),
        ({"colour_noise": 1e30}, "colour_noise", "0 to 1"),
        ({"step": -1}, "step", "a number from 0 up"),
        ({"seconds": -1.0}, "seconds", "a number from 0 up"),
        ({"added": -1}, "added", "a number from 0 up"),
    ],
)
def test_descriptions_of_what_cannot_be_are_refused(
    changes: dict[str, Any], culprit: str, value: str, tmp_path: Path
) -> None:
    described(tmp_path, **changes)
    with pytest.raises(InputError) as told:
        load_info(tmp_path)
    assert str(told.value).startswith(f"{tmp_path / 'map.json'}: ")
    assert culprit in str(told.value)
    assert value in str(told.value)


def test_keys_of_a_newer_version_are_ignored_with_a_warning(tmp_path: Path) -> None:
    described(tmp_path, mirrored=True, bidnerf="99.1")
    with pytest.warns(InputWarning, match=r"map\.json: ignored mirrored, .*; bidnerf 99\.1 wrote the map$"):
        assert load_info(tmp_path).bidnerf == "99.1"
    for changes, fault in (({"version": 2}, "version 2"), ({"step": "many"}, "step is 'many'")):
        described(tmp_path, bidnerf="99.1", **changes)
        with refused(where="map.json", found=fault, expected="or earlier; bidnerf 99.1 wrote it, so upgrade bidnerf"):
            load_info(tmp_path)


def test_a_training_of_any_length_is_described(bidnerf: Run, tmp_path: Path) -> None:
    described(tmp_path, seconds=1e308)
    assert bidnerf("info", tmp_path).status == 0


@pytest.mark.parametrize(
    ("change", "found"),
    [
        ({"colour_layers": 1_000_000}, "colour_layers is 1000000"),
        # 64 levels of 2^30 entries would be half a terabyte.
        (
            {"encoding": {"levels": 64, "log2_table_size": 30, "finest_resolution": 1e6, "base_resolution": 1e4}},
            "tensor 'encoding",
        ),
    ],
)
def test_a_field_that_is_larger_than_its_weights_is_refused_at_once(
    change: dict[str, Any], found: str, tmp_path: Path
) -> None:
    described(tmp_path, config=PLAIN["config"] | change)
    with pytest.raises(InputError, match=found):
        load_map(tmp_path)


def test_a_map_of_hundreds_of_cameras_is_described_without_a_loop_of_tensors(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    many = tuple(replace(CAMERAS[0], name=f"{i}", given_T_world_camera=CAMERAS[1].T_world_camera) for i in range(500))
    write_parts(tmp_path, replace(info(complete=True), cameras=many), state())
    counted = []
    usual = SE3.from_matrix
    monkeypatch.setattr(SE3, "from_matrix", lambda rows: counted.append(len(rows)) or usual(rows))
    assert len(load_map(tmp_path).describe().plain()["moved"]) == 500
    assert len(counted) < 10
