"""``bidnerf bake``, baking as a part of ``train``, and what they are for: ``localize --no-start``."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

import tiny
from bidnerf_core import train
from bidnerf_core.camera import Intrinsics
from bidnerf_core.captures import CaptureReport, training_views
from bidnerf_core.captures.report import CoverageRecord
from bidnerf_core.cli import bake as command
from bidnerf_core.cli import main
from bidnerf_core.cli.output import read_views
from bidnerf_core.datasets import open_dataset
from bidnerf_core.frames import View
from bidnerf_core.mapping import BakeConfig, TrackedViews, tracked_views
from bidnerf_core.maps import Map, baking, load_info, load_map
from bidnerf_core.maps.files import save_capture
from bidnerf_core.scenes import HomogeneousBall
from bidnerf_hashgrid import HashGridConfig
from bidnerf_hashgrid import backend as hashgrid
from commands import Run

pytestmark = pytest.mark.slow


COARSE = ["--cells", "30000"]


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Images large enough to recognise something in, and a map that was trained for a moment only."""
    folder = tmp_path_factory.mktemp("bake")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tiny, "SIZE", 64)
        patch.setattr(tiny, "CAMERA", Intrinsics(85.0, 85.0, 32.0, 32.0, 64, 64))
        tiny.write_dataset(folder / "data", train=24)
    assert main(["train", str(folder / "data"), "--out", str(folder / "map"), *tiny.options(4)]) == 0
    return folder


@pytest.fixture
def folder(shared: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(shared / "map", tmp_path / "map"))


def test_a_baked_map_needs_no_start(shared: Path, folder: Path, bidnerf: Run) -> None:
    data = shared / "data"
    status, out, err = bidnerf("bake", folder, "--data", data, *COARSE)
    assert (status, out) == (0, "")
    assert "from 24 measured views" in err
    facts = json.loads(bidnerf("info", folder, "--json")[1])
    assert facts["surfels"] > 1000
    surface = load_map(folder).surface
    assert surface is not None
    assert facts["surface"] == {
        "cell": surface.cell,
        "cells": len(surface.index.entries),
        "MiB": round(surface.bytes / 2**20, 1),
    }
    for said in (
        f"{facts['surface']['cells']} cells",
        f"{facts['surface']['MiB']} MiB",
        f"side of {surface.cell:.3g}",
    ):
        assert said in err
    status, out, _ = bidnerf("localize", folder, data, "--frame", "t_0000", "--no-start", "--json")
    found = json.loads(out)
    assert (status, found["method"]) == (0, "auto")
    assert found["error"]["translation"] < 0.1
    assert found["error"]["rotation_deg"] < 2
    assert len(found["covariance"]) == len(found["covariance"][0]) == 6
    points = folder / "points.txt"
    points.write_text("0 0 3\n0.1 0 3\n")
    place = ["localize", folder, data, "--frame", "t_0000", "--no-start"]
    with_points = json.loads(bidnerf(*place, "--depth-points", points, "--json")[1])
    assert with_points["loss"] != found["loss"]  # they are used beside the image's own depth
    shown = bidnerf("localize", folder, data, "--frame", "t_0000", "--no-start")[1]
    assert "start error  no start" in shown
    assert "one standard deviation" in shown


def test_without_a_surface_no_start_is_refused_in_a_line(shared: Path, folder: Path, bidnerf: Run) -> None:
    status, out, err = bidnerf("localize", folder, shared / "data", "--frame", "t_0000", "--no-start")
    assert (status, out, err.count("\n")) == (1, "", 1)
    assert "'bidnerf bake'" in err
    assert "needs a start" in err


@pytest.fixture
def _ball(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is baked is a ball, whatever the map shows."""

    def ball(folder: Path, *place: str, **options: bool) -> Map:
        return replace(load_map(folder, *place, **options), field=HomogeneousBall(0.5, 300.0))

    monkeypatch.setattr(command, "load_map", ball)


@pytest.mark.usefixtures("_ball")
def test_a_map_that_was_imported_is_baked_from_where_a_dataset_was_seen(
    folder: Path, tmp_path: Path, bidnerf: Run
) -> None:
    described = json.loads((folder / "map.json").read_text())
    (folder / "map.json").write_text(json.dumps(described | {"cameras": []}))
    bake = ["bake", folder, "--rays", "20000", "--cells", "20000"]
    status, _, err = bidnerf(*bake)
    assert (status, err.count("\n")) == (1, 1)
    assert "--data" in err
    tiny.write_dataset(tmp_path / "data", train=9, depth=False)
    status, _, err = bidnerf(*bake, "--data", tmp_path / "data")
    assert status == 0
    assert "from 9 rendered views" in err
    surface = load_map(folder).surface
    assert surface is not None
    assert len(surface.keyframes) == 9


@pytest.mark.usefixtures("_ball")
def test_a_map_is_baked_from_what_it_renders(folder: Path, bidnerf: Run) -> None:
    status, out, err = bidnerf("bake", folder, "--rays", "20000", "--cells", "20000")
    assert (status, out) == (0, "")
    assert "from 24 rendered views" in err
    surface = load_map(folder).surface
    assert surface is not None
    height = torch.linalg.vector_norm(surface.surfels.positions, dim=-1) - 0.5
    assert height.abs().max() < surface.cell
    assert len(surface.keyframes) == 24


def test_a_damaged_surface_is_baked_anew(shared: Path, folder: Path, bidnerf: Run) -> None:
    bake = ["bake", folder, "--data", shared / "data", *COARSE]
    assert bidnerf(*bake)[0] == 0
    (folder / str(load_info(folder).surface)).write_bytes(b"")
    status, _, err = bidnerf("info", folder)
    assert (status, err.count("\n")) == (1, 1)
    assert bidnerf(*bake)[0] == 0
    assert load_map(folder).surface is not None


def test_training_bakes_unless_told_otherwise(
    shared: Path, tmp_path: Path, bidnerf: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("bidnerf_core.maps.training.USUAL_BAKE", BakeConfig(cells=20_000))
    train = ["train", shared / "data", *tiny.options(2)]
    assert train.pop() == "--no-bake"
    status, out, err = bidnerf(*train, "--out", tmp_path / "map")
    assert (status, out) == (0, "")
    assert "surface of" in err
    assert load_map(tmp_path / "map").surface is not None
    assert load_map(shared / "map").surface is None


def test_a_map_without_a_surface_to_bake_is_a_map(
    tmp_path: Path, bidnerf: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    tiny.write_dataset(tmp_path / "data", depth=False)
    monkeypatch.setattr("bidnerf_core.maps.training.USUAL_BAKE", BakeConfig(rays=1000, cells=1000))
    train = ["train", tmp_path / "data", *tiny.options(1)[:-1]]
    status, _, err = bidnerf(*train, "--out", tmp_path / "map")
    assert status == 0
    assert "no surface baked: no surface to bake" in err
    assert load_map(tmp_path / "map").info.complete


@pytest.mark.parametrize(
    ("words", "status", "said"),
    [
        (["{none}"], 1, "no such folder"),
        (["{map}", "--cells", "3"], 2, "cells is 3"),
        (["{map}", "--data", "{none}"], 1, "none"),
        (["{map}", "--split", "x", "--data", "{data}"], 1, "no split 'x'"),
        (["{map}", "--frobnicate"], 2, "--frobnicate"),
        (["{map}", "--rendered-landmarks", "--data", "{data}"], 2, "--rendered-landmarks uses no photos"),
    ],
)
def test_mistakes_are_told(
    words: list[str], status: int, said: str, shared: Path, tmp_path: Path, bidnerf: Run
) -> None:
    places = {"none": tmp_path / "none", "map": shared / "map", "data": shared / "data"}
    found, out, err = bidnerf("bake", *(word.format(**places) for word in words))
    assert (found, out, "Traceback" in err) == (status, "", False), err
    assert status == 2 or err.count("\n") == 1
    assert said in err


@pytest.mark.usefixtures("_ball")
def test_how_well_a_field_renders_is_measured_on_photos_alone(
    shared: Path, folder: Path, bidnerf: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Against images that it renders itself any field is perfect."""
    photos = read_views(open_dataset(shared / "data", tiny.BACKGROUND), "train")
    monkeypatch.setattr(baking, "rendered_views", lambda *_: photos[:12])  # sharp enough for landmarks
    bidnerf("bake", folder, *COARSE)
    assert load_map(folder).landmarks is not None
    assert load_map(folder).colour_noise is None
    bidnerf("bake", folder, "--data", shared / "data", *COARSE)
    noise = load_map(folder).colour_noise
    assert noise is not None
    assert noise > 0.05  # a ball is not what the photos show
    bidnerf("bake", folder, "--rendered-landmarks", *COARSE)
    assert load_map(folder).landmarks is not None
    assert load_map(folder).colour_noise == noise


@pytest.fixture
def with_photo_landmarks(shared: Path, folder: Path, bidnerf: Run, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The map with landmarks of its photos. Its surface is left alone, and what it renders is like photos."""
    photos = read_views(open_dataset(shared / "data", tiny.BACKGROUND), "train")
    monkeypatch.setattr("bidnerf_core.maps.map.bake_surface", lambda *_: None)
    monkeypatch.setattr(Map, "with_surface", lambda scene, surface: scene)
    monkeypatch.setattr(baking, "rendered_views", lambda *_: photos[:12])  # sharp enough for landmarks
    assert bidnerf("bake", folder, "--data", shared / "data").status == 0
    assert load_info(folder).landmark_source == "photos"
    return folder


def test_landmarks_of_photos_are_kept(with_photo_landmarks: Path, bidnerf: Run) -> None:
    before = load_info(with_photo_landmarks)
    status, out, err = bidnerf("bake", with_photo_landmarks)
    assert (status, out, err.count("\n")) == (0, "", 1)
    assert "its landmarks from photos are kept; --rendered-landmarks" in err
    assert load_info(with_photo_landmarks) == before


def test_landmarks_of_rendered_images_are_replaced_each_time(
    with_photo_landmarks: Path, bidnerf: Run
) -> None:
    photos = load_info(with_photo_landmarks)
    assert "rendered images" in bidnerf("bake", with_photo_landmarks, "--rendered-landmarks").err
    first = load_info(with_photo_landmarks)
    assert (first.landmark_source, first.colour_noise) == ("rendered images", photos.colour_noise)
    assert first.landmarks != photos.landmarks
    assert "kept" not in bidnerf("bake", with_photo_landmarks).err
    assert load_info(with_photo_landmarks).landmarks != first.landmarks


def test_damaged_landmarks_of_photos_are_replaced(with_photo_landmarks: Path, bidnerf: Run) -> None:
    damaged = with_photo_landmarks / str(load_info(with_photo_landmarks).landmarks)
    damaged.write_bytes(b"")
    status, _, err = bidnerf("bake", with_photo_landmarks)
    assert status == 0
    assert str(damaged) in err
    assert load_info(with_photo_landmarks).landmark_source == "rendered images"
    assert load_map(with_photo_landmarks).landmarks is not None


def test_landmarks_of_photos_are_built_once_for_training_and_baking(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without depth or silhouettes, training takes distances from landmarks, and the map keeps those landmarks."""
    monkeypatch.setattr(tiny, "CAMERA", Intrinsics(85.0, 85.0, 32.0, 32.0, 64, 64))
    photos = [replace(v, frame=replace(v.frame, depth=None, alpha=None)) for v in tiny.views(24)]
    built, seen = [], []

    def tracked(views: Sequence[View], features: str, **options: Any) -> TrackedViews:
        built.append(len(views))
        return tracked_views(views, features, **options)

    def trained(field: Any, views: Sequence[View], *rest: Any) -> None:
        seen.append(sum(len(v.landmarks.distance) for v in views if v.landmarks is not None))
        hashgrid.train(field, views, *rest)

    for part in (baking, training_views):
        monkeypatch.setattr(part, "tracked_views", tracked)
    monkeypatch.setattr("bidnerf_core.maps.map.bake_surface", lambda *_: None)
    monkeypatch.setattr(Map, "with_surface", lambda scene, surface: scene)
    watched = SimpleNamespace(summary="", config_type=HashGridConfig, build=hashgrid.build, train=trained)
    monkeypatch.setattr("bidnerf_core.maps.training.load_backend", lambda name: watched)
    stored = train(photos, config=tiny.config(4), background=tiny.BACKGROUND)
    assert built == [24]
    assert seen[0] > 100
    assert stored.landmarks is not None
    assert stored.landmarks.trial.images == 8
    assert stored.bounds.contracted


def test_images_with_silhouettes_are_trained_on_without_landmarks() -> None:
    bare = [replace(v, frame=replace(v.frame, depth=None)) for v in tiny.views(3)]
    tracked, views = training_views.located(bare)
    assert tracked is None
    assert all(view.landmarks is None for view in views)


def test_photos_leave_a_record_that_info_shows_and_draws(
    shared: Path, folder: Path, bidnerf: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("bidnerf_core.maps.map.bake_surface", lambda *_: None)
    monkeypatch.setattr(Map, "with_surface", lambda scene, surface: scene)
    assert json.loads(bidnerf("info", folder, "--json")[1])["capture"] is None
    status, _, err = bidnerf("info", folder, "--draw", folder / "capture.png")
    assert (status, err.count("\n")) == (1, 1)
    assert "no record of its photos" in err
    status, _, err = bidnerf("bake", folder, "--data", shared / "data")
    assert status == 0
    lines = [line for line in err.splitlines() if "24 photos, " in line and "horizon" in line]
    assert len(lines) == 1
    facts = json.loads(bidnerf("info", folder, "--json")[1])
    assert len(facts["capture"]["photos"]) == 24
    status, out, _ = bidnerf("info", folder, "--draw", folder / "capture.png")
    assert (status, lines[0] in out) == (0, True)
    assert (folder / "capture.png").read_bytes().startswith(b"\x89PNG")
    status, _, err = bidnerf("info", folder, "--draw", folder / "capture.jpg")
    assert (status, err.count("\n")) == (1, 1)
    assert "PNG" in err


@pytest.mark.parametrize("content", ["", "{}", '{"photos": 3}'])
def test_a_damaged_record_of_photos_is_named_in_a_line(folder: Path, content: str, bidnerf: Run) -> None:
    save_capture(folder, load_info(folder), CaptureReport((), CoverageRecord()))
    assert bidnerf("info", folder).status == 0
    file = folder / str(load_info(folder).capture)
    file.write_text(content)
    status, _, err = bidnerf("info", folder)
    assert (status, err.count("\n")) == (1, 1)
    assert file.name in err
    file.unlink()
    assert "no such file" in bidnerf("info", folder).err


def test_photos_of_another_scene_are_not_baked_into_a_map(
    shared: Path, folder: Path, tmp_path: Path, bidnerf: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    tiny.write_dataset(tmp_path / "other", train=9)
    for file in (tmp_path / "other").glob("transforms*.json"):  # photos from elsewhere, as of another scene
        described = json.loads(file.read_text())
        for number, frame in enumerate(described["frames"]):
            frame["transform_matrix"][0][3] += 0.01 * (1 + number)
        file.write_text(json.dumps(described))
    never_baked = ["bake", shutil.copytree(folder, tmp_path / "fresh"), "--data", tmp_path / "other", *COARSE]
    monkeypatch.setattr("bidnerf_core.maps.same_scene.colour_noise", lambda *_: 0.31)
    assert bidnerf(*never_baked).status == 1
    monkeypatch.setattr(baking, "colour_noise", lambda *_: 0.1)
    assert bidnerf("bake", folder, "--data", shared / "data", *COARSE).status == 0
    before = {file.name: file.read_bytes() for file in folder.iterdir()}
    monkeypatch.setattr("bidnerf_core.maps.same_scene.colour_noise", lambda *_: 0.31)
    status, _, err = bidnerf("bake", folder, "--data", tmp_path / "other", *COARSE)
    assert (status, err.count("\n")) == (1, 1)
    assert "differ from the photos" in err
    assert "by 31%" in err
    assert {file.name: file.read_bytes() for file in folder.iterdir()} == before
    monkeypatch.setattr(
        "bidnerf_core.maps.same_scene.colour_noise", lambda *_: 0.15
    )  # new photos of the same scene
    assert bidnerf("bake", folder, "--data", tmp_path / "other", *COARSE).status == 0
