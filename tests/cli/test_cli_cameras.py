"""Cameras of datasets on the command line: that of the colour images, and that of depth beside it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

import tiny
from bidnerf_core.cli import main
from bidnerf_core.datasets import open_dataset
from commands import Run
from tum_folder import Recorded, write_recording


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """``data`` in the layout of TUM RGB-D without a camera, its ``camera.json``, a ``sensor.json``, and a ``map``."""
    folder = tmp_path_factory.mktemp("cameras")
    posed = open_dataset(tiny.write_dataset(folder / "posed"))
    views = posed.views("train")
    write_recording(folder / "data", [Recorded(1.0 + n / 10, view) for n, view in enumerate(views)])
    camera = views[0].frame.intrinsics
    size = {"w": camera.width, "h": camera.height}
    described = {"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy} | size
    (folder / "camera.json").write_text(json.dumps(described))
    moved = torch.eye(4)
    moved[2, 3] = 0.3
    (folder / "sensor.json").write_text(json.dumps(described | {"T_colour_depth": moved.tolist()}))
    train = ["train", folder / "data", "--out", folder / "map", "--camera", folder / "camera.json"]
    assert main([*map(str, train), *tiny.options()]) == 0
    return folder


def test_a_recording_without_a_camera_says_how_to_give_one(
    bidnerf: Run, shared: Path, tmp_path: Path
) -> None:
    found = bidnerf("train", shared / "data", "--out", tmp_path / "map", *tiny.options())
    assert found.status == 1
    assert "or --camera with one of freiburg1, freiburg2 and freiburg3, or a file" in found.err


def test_an_unknown_name_of_a_camera_is_answered_with_the_known_ones(
    bidnerf: Run, shared: Path, tmp_path: Path
) -> None:
    words = ["train", shared / "data", "--out", tmp_path / "map", "--camera", "freiburg9"]
    found = bidnerf(*words, *tiny.options())
    assert found.status == 1
    assert "freiburg9: no such file" in found.err
    assert "one of freiburg1, freiburg2 and freiburg3, or a file" in found.err


def test_localize_takes_the_camera_and_the_registration(bidnerf: Run, shared: Path) -> None:
    begin = ["localize", shared / "map", shared / "data", "--json", "--method", "bid", "--max-steps", 2]
    begin += ["--rays", 64, "--perturb", 0.02, 1, "--depth-weight", 1, "--camera", shared / "camera.json"]
    plain, moved = bidnerf(*begin), bidnerf(*begin, "--register-depth", shared / "sensor.json")
    assert (plain.status, moved.status) == (0, 0), plain.err + moved.err
    first, other = (json.loads(found.out.splitlines()[0]) for found in (plain, moved))
    assert first["loss"] != other["loss"]
    as_stored = bidnerf(*begin, "--register-depth", "no")
    assert json.loads(as_stored.out.splitlines()[0])["loss"] == first["loss"]


def test_render_compares_with_registered_depth(bidnerf: Run, shared: Path, tmp_path: Path) -> None:
    given = ["render", shared / "map", shared / "data", "--camera", shared / "camera.json"]
    plain = bidnerf(*given, "--out", tmp_path / "plain")
    moved = bidnerf(*given, "--out", tmp_path / "moved", "--register-depth", shared / "sensor.json")
    assert (plain.status, moved.status) == (0, 0), plain.err + moved.err
    assert plain.out.partition("depth error")[0] == moved.out.partition("depth error")[0]
    assert plain.out != moved.out


@pytest.mark.parametrize(
    "command", ["train", "localize", "render", "track", "bake", "evaluate", "compare", "extend"]
)
def test_a_sensor_that_is_missing_is_named(command: str, bidnerf: Run, shared: Path, tmp_path: Path) -> None:
    where = {
        "train": [shared / "data", "--out", tmp_path / "map", *tiny.options()],
        "localize": [shared / "map", shared / "data"],
        "render": [shared / "map", shared / "data", "--out", tmp_path / "images"],
        "track": [shared / "map", shared / "data", "--out", tmp_path / "path.txt"],
        "bake": [shared / "map", "--data", shared / "data"],
        "evaluate": [shared / "map", shared / "data", "--out", tmp_path / "results.jsonl"],
        "compare": [shared / "map", shared / "data"],
        "extend": [shared / "map", shared / "data"],
    }[command]
    cameras = ["--camera", shared / "camera.json", "--register-depth", tmp_path / "none.json"]
    found = bidnerf(command, *where, *cameras)
    assert found.status == 1
    assert "none.json: no such file" in found.err


def test_trials_record_the_camera_and_are_resumed_by_it(bidnerf: Run, shared: Path, tmp_path: Path) -> None:
    words = [
        "evaluate",
        shared / "map",
        shared / "data",
        "--out",
        tmp_path / "r.jsonl",
        "--trials",
        1,
        "--size",
        0.5,
    ]
    words += [
        "--method",
        "bid",
        "--max-steps",
        2,
        "--rays",
        64,
        "--workers",
        1,
        "--camera",
        shared / "camera.json",
    ]
    first = bidnerf(*words)
    assert first.status == 0, first.err
    assert json.loads((tmp_path / "r.jsonl").read_text())["trial"]["camera"] == "camera.json"
    assert "1 of 1 trials are already there" in bidnerf(*words).err
    other = bidnerf(*words, "--depth-unit", 0.001)
    assert other.status == 0, other.err
    assert "already there" not in other.err
    assert (tmp_path / "r.jsonl").read_text().count("\n") == 2


def test_options_of_datasets_need_one(bidnerf: Run, shared: Path, tmp_path: Path) -> None:
    photo = next((shared / "data" / "rgb").iterdir())
    found = bidnerf("extend", shared / "map", photo, "--camera", shared / "camera.json")
    assert found.status == 2
    assert f"--camera is for a dataset, but {photo} is none" in found.err
    words = ["evaluate", "demo:blobs", "--out", tmp_path / "r.jsonl", "--depth-unit", 0.001]
    found = bidnerf(*words)
    assert found.status == 1
    assert "leave out camera, register_depth and depth_unit" in found.err
