"""Maps on disk: what is saved is what is loaded, and whenever writing stops, one whole map is there."""

from __future__ import annotations

import errno
import functools
import itertools
import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import save as tensors_to_bytes
from torch import Tensor, nn

import baked
import tiny
from bidnerf_core.backend import load_backend
from bidnerf_core.captures import stored_cameras
from bidnerf_core.errors import InputError
from bidnerf_core.fields import SceneBounds
from bidnerf_core.geometry import SE3
from bidnerf_core.io import to_plain, write_file
from bidnerf_core.mapping import SurfaceMap, surface_tensors
from bidnerf_core.maps import MapInfo, files, load_info, load_map, save_map
from bidnerf_core.maps import map as map_module
from bidnerf_core.maps.files import load_state, save_surface
from bidnerf_core.scenes import HomogeneousBall
from bidnerf_core.training import TrainingState
from bidnerf_hashgrid import HashGridField, backend
from interruptions import FULL, Stopped, outcomes, striking

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
            value.copy_(torch.rand(value.shape, generator=generator) > 0.5 if value.dtype == torch.bool
                        else torch.randn(value.shape, generator=generator))  # fmt: skip
    return made


@functools.cache
def state(step: int = 5) -> TrainingState:
    """Another one for each step."""
    moments = {
        "generator": torch.Generator().manual_seed(step).get_state(),
        "0.step": torch.tensor(float(step)),
    }
    return TrainingState(step, field(step).state_dict(), moments)


def assert_equal(found: dict[str, Tensor], expected: dict[str, Tensor]) -> None:
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        assert found[name].dtype == value.dtype
        assert torch.equal(found[name], value), name


def names(folder: Path) -> set[str]:
    return {file.name for file in folder.iterdir()}


@pytest.mark.parametrize("complete", [True, False])
def test_what_is_saved_is_what_is_loaded(complete: bool, tmp_path: Path) -> None:
    saved = save_map(tmp_path / "a" / "map", info(complete=complete), state())
    assert replace(saved, weights="", training=None) == info(complete=complete)
    assert load_info(tmp_path / "a" / "map") == saved
    loaded = load_map(tmp_path / "a" / "map")
    assert loaded.info == saved
    assert loaded.bounds == BOUNDS
    assert isinstance(loaded.field, nn.Module)
    assert_equal(loaded.field.state_dict(), state().field)
    assert not any(parameter.requires_grad for parameter in loaded.field.parameters())
    assert not loaded.field.training
    if complete:
        with pytest.raises(InputError, match="complete"):
            load_state(tmp_path / "a" / "map", saved, field(1))
    else:
        resumed = load_state(tmp_path / "a" / "map", saved, field(1))
        assert resumed.step == 5
        assert_equal(resumed.field, state().field)
        assert_equal(resumed.optimizer, state().optimizer)


def test_what_follows_from_the_occupancy_is_brought_up_to_date_on_loading(tmp_path: Path) -> None:
    sparse = field(0)
    sparse.occupancy.restrict(torch.zeros(16, 16, 16, dtype=torch.bool))
    save_map(tmp_path, info(), TrainingState(5, sparse.state_dict(), {}))
    loaded = load_map(tmp_path).field
    assert isinstance(loaded, HashGridField)
    assert not loaded.occupancy.near_occupied.any()
    assert loaded.coarse_sampler.occupied.any()


def test_views_of_shared_or_strided_memory_are_saved(tmp_path: Path) -> None:
    tensors = dict(state().field)
    weight = tensors["geometry.0.weight"]
    tensors["geometry.0.weight"] = weight.t().contiguous().t()
    save_map(tmp_path, info(), TrainingState(5, tensors, {}))
    loaded = load_map(tmp_path).field
    assert isinstance(loaded, nn.Module)
    assert_equal(loaded.state_dict(), state().field)


def test_nothing_on_disk_can_run(tmp_path: Path) -> None:
    save_map(tmp_path, info(), state())
    assert {file.suffix for file in tmp_path.iterdir()} == {".json", ".safetensors"}
    (tmp_path / load_info(tmp_path).weights).write_bytes(b"\x80\x04.")  # a pickle
    with pytest.raises(InputError, match="expected a safetensors file"):
        load_map(tmp_path)


def test_old_files_are_removed_and_others_are_left_alone(tmp_path: Path) -> None:
    mine = ["weights-best.safetensors", "training-00000001-aaaaaaaa.txt", ".map.json.swp", "notes"]
    stray = [".weights-00000004-0a1b2c3d.safetensors.0a1b2c3d", ".map.json.0a1b2c3d",
             "training-00000004-0a1b2c3d.safetensors"]  # fmt: skip
    for name in (*mine, *stray):
        (tmp_path / name).touch()
    save_map(tmp_path, info(step=5), state(5))
    saved = save_map(tmp_path, info(step=6), state(6))
    assert saved.training is not None
    assert names(tmp_path) == {*mine, "map.json", saved.weights, saved.training}
    done = save_map(tmp_path, info(step=7, complete=True), state(7))
    assert names(tmp_path) == {*mine, "map.json", done.weights}


# Whenever the writing stops, the folder holds one whole map.


@pytest.mark.parametrize("error", [FULL, Stopped()], ids=["full", "stop"])
@pytest.mark.parametrize("complete", [True, False], ids=["complete", "checkpoint"])
@pytest.mark.parametrize("before", [True, False], ids=["second save", "first save"])
def test_a_save_that_stops_anywhere_leaves_a_whole_map(
    before: bool, complete: bool, error: BaseException, tmp_path: Path
) -> None:
    places = (tmp_path / str(number) for number in itertools.count())
    folder = tmp_path

    def attempt() -> None:
        nonlocal folder
        folder = next(places)
        folder.mkdir()
        if before:
            with pytest.MonkeyPatch.context() as patch:
                patch.setattr(files, "write_file", _written)  # not counted
                save_map(folder, info(step=5), state(5))
        save_map(folder, info(step=6, complete=complete), state(6))

    steps = []
    for raised in outcomes(attempt, error):
        if isinstance(raised, OSError):
            assert str(raised.filename).startswith(str(folder))
        if before or (folder / "map.json").exists():
            steps.append((raised, assert_whole(folder)))
        else:
            steps.append((raised, 5))
            assert names(folder) == set()
    assert steps[-1] == (None, 6)
    assert len(steps) > (8 if complete else 12)  # open, sync, replace and sync again, of two files or three
    assert all(step == 6 for raised, step in steps if raised is None)
    assert all(step == 5 for raised, step in steps if isinstance(raised, OSError))


def _written(path: Path, content: bytes) -> None:
    with open(path, "wb") as file:
        file.write(content)


def assert_whole(folder: Path) -> int:
    loaded = load_map(folder)
    assert isinstance(loaded.field, nn.Module)
    assert_equal(loaded.field.state_dict(), state(loaded.info.step).field)
    assert names(folder) == {"map.json", loaded.info.weights, loaded.info.training} - {None}
    return loaded.info.step


def test_a_map_that_a_training_replaces_while_it_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Between the description and the weights, the next checkpoint comes."""
    save_map(tmp_path, info(step=5), state(5))
    read = map_module.read_tensors
    pending = [lambda: save_map(tmp_path, info(step=6), state(6))]

    def late(path: Path, expected: str) -> dict[str, Tensor]:
        if pending:
            pending.pop()()
        return read(path, expected)

    monkeypatch.setattr(map_module, "read_tensors", late)
    loaded = load_map(tmp_path)
    assert loaded.info.step == 6
    assert isinstance(loaded.field, nn.Module)
    assert_equal(loaded.field.state_dict(), state(6).field)


def test_a_damaged_description_makes_no_save_remove_anything(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    save_map(tmp_path, info(step=5), state(5))
    (tmp_path / "map.json").write_text("{")
    before = names(tmp_path)
    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", striking(Path.replace, [], 0, FULL))
        with pytest.raises(OSError, match="No space left"):
            save_map(tmp_path, info(step=6), state(6))
    assert names(tmp_path) == before


def test_what_json_cannot_hold_is_told_before_anything_is_written(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"config\.learning_rate is nan"):
        save_map(tmp_path / "map", replace(info(), config={"learning_rate": float("nan")}), state())
    assert not (tmp_path / "map").exists()


@pytest.mark.parametrize("error", [FULL, Stopped()], ids=["full", "stop"])
def test_a_file_is_written_whole_or_not_at_all(error: BaseException, tmp_path: Path) -> None:
    def attempt() -> None:
        _written(path, b"old")
        write_file(path, b"new")

    path, found = tmp_path / "x", []
    for raised in outcomes(attempt, error):
        found.append(path.read_bytes())
        assert names(tmp_path) == {"x"}
        if isinstance(raised, OSError):
            assert (raised.errno, raised.filename) == (errno.ENOSPC, str(path))
    assert found[:3] == [b"old"] * 3  # open, sync, replace
    assert found[3:] == [b"new"] * len(found[3:])


# What a backend builds is judged as well.


def test_a_backend_that_builds_something_else_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    save_map(tmp_path, info(), state())
    chosen = load_backend("hashgrid")
    monkeypatch.setattr(type(chosen), "build", lambda *_: HomogeneousBall(1.0, 1.0))
    with pytest.raises(InputError, match=r"built a HomogeneousBall, expected an nn\.Module"):
        load_map(tmp_path)


# The baked surface is kept beside the weights that it shows.


def with_surface(folder: Path, surface: SurfaceMap, complete: bool = True) -> MapInfo:
    return save_surface(folder, save_map(folder, info(complete=complete), state()), surface)


def test_a_surface_comes_back_as_it_was(tmp_path: Path) -> None:
    saved = with_surface(tmp_path, baked.toy(), complete=False)
    loaded = load_map(tmp_path)
    assert loaded.info == saved
    assert loaded.surface is not None
    assert_equal(surface_tensors(loaded.surface), surface_tensors(baked.toy()))
    assert isinstance(loaded.field, nn.Module)
    assert_equal(loaded.field.state_dict(), state().field)
    assert names(tmp_path) == {"map.json", saved.weights, saved.training, saved.surface}
    assert load_map(tmp_path, baked=False).surface is None


def test_a_new_surface_replaces_the_old_one_and_training_drops_it(tmp_path: Path) -> None:
    first = with_surface(tmp_path, baked.patch())
    second = save_surface(tmp_path, first, baked.toy())
    assert names(tmp_path) == {"map.json", second.weights, second.surface}
    assert second.surface != first.surface
    trained = save_map(tmp_path, second, state(6))
    assert trained.surface is None
    assert load_map(tmp_path).surface is None
    assert names(tmp_path) == {"map.json", trained.weights}


def test_a_surface_of_other_weights_is_refused(tmp_path: Path) -> None:
    before = save_map(tmp_path, info(complete=True), state())
    after = save_map(tmp_path, info(complete=True), state())
    with pytest.raises(InputError, match="retrained while"):
        save_surface(tmp_path, before, baked.toy())
    assert load_info(tmp_path) == after
    assert names(tmp_path) == {"map.json", after.weights}


def test_a_surface_that_cannot_be_written_leaves_the_map(tmp_path: Path) -> None:
    saved = with_surface(tmp_path, baked.patch())
    for raised in outcomes(lambda: save_surface(tmp_path, load_info(tmp_path), baked.patch()), FULL):
        found = load_map(tmp_path)
        assert found.surface is not None
        assert names(tmp_path) == {"map.json", saved.weights, found.info.surface}
        if raised is not None:
            assert str(raised.filename).startswith(str(tmp_path))


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"\x80\x04.", "expected a safetensors file"),
        (None, "no such file"),
        ({"rgb": torch.ones(2, 3)}, "can recreate"),
    ],
    ids=["no tensors", "missing", "other tensors"],
)
def test_a_damaged_surface_is_named(content: Any, said: str, tmp_path: Path) -> None:
    saved = with_surface(tmp_path, baked.patch())
    path = tmp_path / str(saved.surface)
    if content is None:
        path.unlink()
    elif isinstance(content, bytes):
        path.write_bytes(content)
    else:
        write_file(path, tensors_to_bytes(content))
    with pytest.raises(InputError, match=said) as told:
        load_map(tmp_path)
    assert str(path) in str(told.value)
    assert "\n" not in str(told.value)
    assert load_map(tmp_path, baked=False).surface is None
    save_surface(tmp_path, load_info(tmp_path), baked.patch())  # which mends it
    assert load_map(tmp_path).surface is not None


def _with_weights(folder: Path, name: str, value: Tensor) -> Path:
    path = folder / save_map(folder, info(complete=True), state()).weights
    write_file(path, tensors_to_bytes(dict(state().field) | {name: value}))
    return path


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda value: value.int(), "has dtype int32, expected float32"),
        (lambda value: torch.full_like(value, torch.nan), "holds NaN"),
    ],
    ids=["int", "nan"],
)
@pytest.mark.parametrize("name", ["occupancy.peak", "colour.0.bias"])
def test_weights_and_buffers_of_another_kind_are_refused(
    name: str, change: Callable[[Tensor], Tensor], said: str, tmp_path: Path
) -> None:
    path = _with_weights(tmp_path, name, change(state().field[name]))
    with pytest.raises(InputError, match=said) as told:
        load_map(tmp_path)
    assert str(told.value).startswith(f"{path}: tensor {name!r}")


@pytest.mark.parametrize(
    "rows", [((2.0, 0.0, 0.0, 0.0), *torch.eye(4).tolist()[1:]), torch.eye(4).tolist()[:3]]
)
def test_cameras_without_a_rigid_pose_are_refused(rows: list[list[float]], tmp_path: Path) -> None:
    save_map(tmp_path, info(), state())
    described = json.loads((tmp_path / "map.json").read_text())
    described["cameras"][1]["T_world_camera"] = list(rows)
    (tmp_path / "map.json").write_text(json.dumps(described))
    with pytest.raises(InputError, match=r"map\.json: pose of camera '.+' is not a rigid transform"):
        load_info(tmp_path)


@pytest.mark.parametrize("far", [1e308, 1e16])
def test_bounds_beyond_single_precision_are_refused(far: float, tmp_path: Path) -> None:
    save_map(tmp_path, info(), state())
    described = json.loads((tmp_path / "map.json").read_text())
    described["bounds"]["far"] = far
    (tmp_path / "map.json").write_text(json.dumps(described))
    with pytest.raises(InputError, match=r"bounds: .* m is too large, expected at most 1e\+15 m"):
        load_info(tmp_path)


@pytest.mark.parametrize("value", [-1e30, 3e38, math.nan, -math.inf])
def test_weights_that_no_training_gives_are_refused(tmp_path: Path, value: float) -> None:
    saved = save_map(tmp_path, info(step=5), state(5))
    tensors = state(5).field
    name = next(key for key, held in tensors.items() if held.is_floating_point())
    write_file(
        tmp_path / saved.weights, tensors_to_bytes(tensors | {name: torch.full_like(tensors[name], value)})
    )
    with pytest.raises(InputError, match="expected trained weights"):
        load_map(tmp_path)


def test_noise_of_poses_that_no_image_has_is_refused(tmp_path: Path) -> None:
    save_map(tmp_path, info(), state())
    described = json.loads((tmp_path / "map.json").read_text())
    described["pose_refinement"] = {"noise_before": 1e308, "noise_after": 0.3, "refined": False}
    (tmp_path / "map.json").write_text(json.dumps(described))
    with pytest.raises(
        InputError, match=r"pose_refinement: the keypoint noise is 1e\+308, expected 0 to 1e\+06"
    ):
        load_info(tmp_path)


def test_a_map_of_thousands_of_cameras_is_described_without_a_loop_of_tensors(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    many = tuple(
        replace(CAMERAS[0], name=f"{i}", given_T_world_camera=CAMERAS[1].T_world_camera) for i in range(3000)
    )
    save_map(tmp_path, replace(info(complete=True), cameras=many), state())
    counted = []
    usual = SE3.from_matrix
    monkeypatch.setattr(SE3, "from_matrix", lambda rows: counted.append(len(rows)) or usual(rows))
    assert len(load_map(tmp_path).describe().moved) == 3000
    assert len(counted) < 10
