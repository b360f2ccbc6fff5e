"""Cameras of datasets on the command line: that of the colour images, and that of depth beside it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch

import tiny
from bidnerf_core.datasets import open_dataset
from commands import Run, assert_refused
from tum_folder import Recorded, write_recording

QUICK = ["--method", "bid", "--max-steps", 2, "--rays", 64]
PRESETS = "freiburg1, freiburg2 and freiburg3"


@pytest.fixture(scope="module")
def given(shared: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """``data`` in the layout of TUM RGB-D without a camera, its ``camera.json``, and a ``sensor.json``."""
    folder = tmp_path_factory.mktemp("cameras")
    views = open_dataset(shared / "data").views("train")
    write_recording(folder / "data", [Recorded(1.0 + n / 10, view) for n, view in enumerate(views)])
    camera = views[0].frame.intrinsics
    size = {"w": camera.width, "h": camera.height}
    described = {"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy} | size
    (folder / "camera.json").write_text(json.dumps(described))
    moved = torch.eye(4)
    moved[2, 3] = 0.3
    (folder / "sensor.json").write_text(json.dumps(described | {"T_colour_depth": moved.tolist()}))
    return folder


def test_a_recording_is_trained_on_with_a_camera_that_is_known(bidnerf: Run, given: Path, tmp_path: Path) -> None:
    train = ["train", given / "data", "--out", tmp_path / "map", *tiny.options(1)]
    assert_refused(bidnerf(*train), 1, "--camera", PRESETS, "a file")
    assert_refused(bidnerf(*train, "--camera", "freiburg9"), 1, "freiburg9: no such file", PRESETS, "a file")
    assert bidnerf(*train, "--camera", given / "camera.json").status == 0


def test_localize_takes_the_camera_and_the_registration(bidnerf: Run, shared: Path, given: Path) -> None:
    begin = ["localize", shared / "map", given / "data", "--json", *QUICK, "--perturb", 0.02, 1]
    begin += ["--depth-weight", 1, "--camera", given / "camera.json"]
    plain, moved = bidnerf(*begin), bidnerf(*begin, "--register-depth", given / "sensor.json")
    assert (plain.status, moved.status) == (0, 0), plain.err + moved.err
    first, other = (json.loads(found.out.splitlines()[0]) for found in (plain, moved))
    assert first["loss"] != other["loss"]
    as_stored = bidnerf(*begin, "--register-depth", "no")
    assert json.loads(as_stored.out.splitlines()[0])["loss"] == first["loss"]


def test_render_compares_with_registered_depth(bidnerf: Run, shared: Path, given: Path, tmp_path: Path) -> None:
    render = ["render", shared / "map", given / "data", "--camera", given / "camera.json"]
    plain = bidnerf(*render, "--out", tmp_path / "plain")
    moved = bidnerf(*render, "--out", tmp_path / "moved", "--register-depth", given / "sensor.json")
    assert (plain.status, moved.status) == (0, 0), plain.err + moved.err
    assert plain.out.partition("depth error")[0] == moved.out.partition("depth error")[0]
    assert plain.out != moved.out


@pytest.mark.parametrize(
    "line",
    [
        "train {data} --out {out}",
        "localize {map} {data}",
        "render {map} {data} --out {out}",
        "bake {map} --data {data}",
        "track {map} {data} --out {out}.txt",
        "evaluate {map} {data} --out {out}.jsonl",
        "compare {map} {data}",
        "extend {map} {data}",
    ],
)
def test_a_sensor_that_is_missing_is_named(line: str, bidnerf: Run, shared: Path, given: Path, tmp_path: Path) -> None:
    places = {"map": shared / "map", "data": given / "data", "out": tmp_path / "out"}
    cameras = ["--camera", given / "camera.json", "--register-depth", tmp_path / "none.json"]
    found = bidnerf(*(word.format(**places) for word in line.split()), *cameras)
    assert_refused(found, 1, tmp_path / "none.json", "no such file", after_remarks=True)


def test_trials_record_the_camera_and_are_resumed_by_it(
    bidnerf: Run, shared: Path, given: Path, tmp_path: Path
) -> None:
    out = tmp_path / "r.jsonl"
    words: list[Any] = ["evaluate", shared / "map", given / "data", "--out", out, *QUICK]
    words += ["--trials", 1, "--size", 0.5, "--workers", 1, "--camera", given / "camera.json"]
    bidnerf(*words).succeed()
    assert json.loads(out.read_text())["trial"]["camera"] == "camera.json"
    assert "1 of 1 trials are already there" in bidnerf(*words).err
    other = bidnerf(*words, "--depth-unit", 0.001).succeed()
    assert "already there" not in other.err
    assert out.read_text().count("\n") == 2
