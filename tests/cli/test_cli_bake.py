"""``bidnerf bake``, baking as a part of ``train``, and what they are for: ``localize`` without a start."""

from __future__ import annotations

import contextlib
import io
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
from balls import HomogeneousBall
from bidnerf import train
from bidnerf.cli import main
from bidnerf_core.camera import Intrinsics
from bidnerf_core.captures import track_landmarks
from bidnerf_core.datasets import DatasetOptions, open_dataset
from bidnerf_core.frames import View
from bidnerf_core.mapping import BakeConfig, TrackedViews, track_views
from bidnerf_core.maps import Map, TrainOptions, load_info, load_map
from bidnerf_hashgrid import HashGridConfig
from bidnerf_hashgrid import backend as hashgrid
from commands import CommandResult, Run, assert_refused
from optional import require

pytestmark = pytest.mark.slow


COARSE = ["--cells", "30000"]


@pytest.fixture(scope="module")
def sharp(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Images large enough to recognise something in, ``data``, and a ``map`` that was trained for a moment only."""
    folder = tmp_path_factory.mktemp("bake")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tiny, "SIZE", 64)
        patch.setattr(tiny, "CAMERA", Intrinsics(85.0, 85.0, 32.0, 32.0, 64, 64))
        tiny.write_dataset(folder / "data", train=16)
    assert main(["train", str(folder / "data"), "--out", str(folder / "map"), *tiny.options(4)]) == 0
    return folder


@pytest.fixture
def folder(sharp: Path, tmp_path: Path) -> Path:
    """A copy of the map, which is not baked."""
    return Path(shutil.copytree(sharp / "map", tmp_path / "map"))


@pytest.fixture(scope="module")
def once(sharp: Path, tmp_path_factory: pytest.TempPathFactory) -> CommandResult:
    """What the command printed that baked the map from the images into ``sharp / "baked"``."""
    words = [
        "bake",
        str(shutil.copytree(sharp / "map", sharp / "baked")),
        "--data",
        str(sharp / "data"),
        *COARSE,
    ]
    with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.redirect_stderr(io.StringIO()) as err:
        status = main(words)
    return CommandResult(status, out.getvalue(), err.getvalue())


@pytest.fixture
def baked(sharp: Path, once: CommandResult, tmp_path: Path) -> Path:
    assert once.status == 0
    return Path(shutil.copytree(sharp / "baked", tmp_path / "baked"))


@pytest.fixture
def _ball(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is baked is the surface of a ball, whatever the map shows, and no landmarks."""

    def ball(folder: Path, *place: str, **options: bool) -> Map:
        return replace(load_map(folder, *place, **options), field=HomogeneousBall(0.5, 300.0))

    monkeypatch.setattr("bidnerf_core.maps.load_map", ball)
    monkeypatch.setattr(Map, "with_landmarks", lambda scene, *_: (scene, None))


@pytest.fixture
def _landmarks_only(sharp: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The surface is left alone, and what the map renders is as sharp as photos."""
    photos = open_dataset(sharp / "data", tiny.BACKGROUND).views("train")
    monkeypatch.setattr("bidnerf_core.maps.map.Map.with_surface", lambda scene, *_: scene)
    monkeypatch.setattr("bidnerf_core.maps.map.render_views", lambda *_: photos[:12])


def test_a_baked_map_needs_no_start(sharp: Path, baked: Path, once: CommandResult, bidnerf: Run) -> None:
    data, folder, err = sharp / "data", baked, once.err
    unbaked = bidnerf("info", sharp / "map", "--plot", folder.parent / "capture.png")
    assert_refused(unbaked, 1, "no record of its photos")
    assert once.out == ""
    assert "from 16 measured views" in err
    facts = json.loads(bidnerf("info", folder, "--json").out)
    assert facts["surfels"] > 1000
    stored = load_map(folder)
    surface = require(stored.surface)
    cells, size = len(surface.index.entries), round(surface.mebibytes, 1)
    assert facts["surface"] == {"cell": surface.cell, "cells": cells, "MiB": size}
    assert require(stored.colour_noise) > 0.05  # a field of four steps is not what the photos show
    place = ["localize", folder, data, "--frame", "t_0000"]
    status, out, _ = bidnerf(*place, "--json")
    found = json.loads(out)
    assert (status, found["method"]) == (0, "auto")
    assert found["error"]["translation"] < 0.1
    assert found["error"]["rotation_deg"] < 2
    assert len(found["covariance"]) == len(found["covariance"][0]) == 6
    shown = bidnerf(*place).out
    assert "one standard deviation" in shown
    # Baking the photos has left a record of them.
    (line,) = [line for line in err.splitlines() if "16 photos, " in line and "horizon" in line]
    assert len(facts["capture"]["photos"]) == 16
    status, out, err = bidnerf("info", folder, "--plot", folder.parent / "capture.png")
    assert (status, line in out) == (0, True)
    assert "capture.png: written" in err
    assert (folder.parent / "capture.png").read_bytes().startswith(b"\x89PNG")
    assert_refused(bidnerf("info", folder, "--plot", folder.parent / "capture.jpg"), 2, ".png")


@pytest.mark.usefixtures("_ball")
def test_a_map_that_was_imported_is_baked_from_where_a_dataset_was_seen(
    folder: Path, tmp_path: Path, bidnerf: Run
) -> None:
    described = json.loads((folder / "map.json").read_text())
    (folder / "map.json").write_text(json.dumps(described | {"cameras": []}))
    bake = ["bake", folder, "--rays", "20000", "--cells", "20000"]
    assert_refused(bidnerf(*bake), 1, "--data")
    tiny.write_dataset(tmp_path / "data", train=9, depth=False)
    err = bidnerf(*bake, "--data", tmp_path / "data").succeed().err
    assert "from 9 rendered views" in err
    surface = require(load_map(folder).surface)
    assert len(surface.keyframes) == 9


@pytest.mark.usefixtures("_ball")
def test_a_map_is_baked_from_what_it_renders_and_anew_if_its_surface_is_damaged(folder: Path, bidnerf: Run) -> None:
    bake = ["bake", folder, "--rays", "20000", "--cells", "20000"]
    for again in (False, True):
        status, out, err = bidnerf(*bake)
        assert (status, out) == (0, "")
        assert "from 16 rendered views" in err
        surface = require(load_map(folder).surface)
        height = torch.linalg.vector_norm(surface.surfels.positions, dim=-1) - 0.5
        assert height.abs().max() < surface.cell
        assert len(surface.keyframes) == 16
        if not again:
            damaged = folder / str(load_info(folder).surface)
            damaged.write_bytes(b"")
            assert_refused(bidnerf("info", folder), 1, damaged)


def test_training_bakes_unless_told_otherwise(
    shared: Path, tmp_path: Path, bidnerf: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("bidnerf_core.maps.training.USUAL_BAKE", BakeConfig(rays=1000, cells=5000))
    *options, last = tiny.options(1)
    assert last == "--no-bake"
    status, out, err = bidnerf("train", shared / "data", *options, "--out", tmp_path / "map")
    assert (status, out) == (0, "")
    assert "surface of" in err
    assert load_map(tmp_path / "map").surface is not None
    assert load_map(shared / "map").surface is None
    # A map in which nothing is opaque has no surface to bake, and is a map.
    tiny.write_dataset(tmp_path / "data", depth=False)
    err = bidnerf("train", tmp_path / "data", *options, "--out", tmp_path / "empty").succeed().err
    assert "no surface baked: no surface to bake" in err
    assert load_map(tmp_path / "empty").info.complete


# Landmarks.


@pytest.mark.usefixtures("_landmarks_only")
def test_how_well_a_field_renders_is_not_measured_on_what_it_renders(folder: Path, bidnerf: Run) -> None:
    """Against images that it renders itself any field is perfect."""
    assert bidnerf("bake", folder).status == 0
    assert load_map(folder).landmarks is not None
    assert load_map(folder).colour_noise is None


@pytest.mark.usefixtures("_landmarks_only")
def test_landmarks_of_photos_are_kept(baked: Path, bidnerf: Run) -> None:
    before = load_info(baked)
    status, out, err = bidnerf("bake", baked)
    assert (status, out, err.count("\n")) == (0, "", 1)
    assert "landmarks from photos are kept; --rendered-landmarks" in err
    assert load_info(baked) == before


@pytest.mark.usefixtures("_landmarks_only")
def test_landmarks_of_rendered_images_are_replaced_each_time(baked: Path, bidnerf: Run) -> None:
    photos = load_info(baked)
    assert photos.landmark_source == "photos"
    assert "rendered images" in bidnerf("bake", baked, "--rendered-landmarks").err
    first = load_info(baked)
    assert (first.landmark_source, first.colour_noise) == ("rendered images", photos.colour_noise)
    assert first.landmarks != photos.landmarks
    assert "kept" not in bidnerf("bake", baked).err
    assert load_info(baked).landmarks != first.landmarks


@pytest.mark.usefixtures("_landmarks_only")
def test_damaged_landmarks_of_photos_are_replaced(baked: Path, bidnerf: Run) -> None:
    damaged = baked / str(load_info(baked).landmarks)
    damaged.write_bytes(b"")
    err = bidnerf("bake", baked).succeed().err
    assert str(damaged) in err
    assert load_info(baked).landmark_source == "rendered images"
    assert load_map(baked).landmarks is not None


def test_landmarks_of_photos_are_built_once_for_training_and_baking(
    sharp: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without depth or silhouettes, training takes distances from landmarks, and the map keeps those landmarks."""
    views = open_dataset(sharp / "data", tiny.BACKGROUND).views("train")
    photos = [replace(v, frame=replace(v.frame, depth=None, alpha=None)) for v in views]
    built, seen = [], []

    def tracked(views: Sequence[View], features: str, **options: Any) -> TrackedViews:
        built.append(len(views))
        return track_views(views, features, **options)

    def trained(field: Any, views: Sequence[View], *rest: Any) -> None:
        seen.append(sum(len(v.landmarks.distance) for v in views if v.landmarks is not None))
        hashgrid.train(field, views, *rest)

    for part in ("maps.map", "captures.training_views"):
        monkeypatch.setattr(f"bidnerf_core.{part}.track_views", tracked)
    monkeypatch.setattr("bidnerf_core.maps.map.Map.with_surface", lambda scene, *_: scene)
    watched = SimpleNamespace(summary="", config_type=HashGridConfig, build=hashgrid.build, train=trained)
    monkeypatch.setattr("bidnerf_core.maps.training.load_backend", lambda *_: watched)
    stored = train(
        photos, config=tiny.config(4), options=TrainOptions(images=DatasetOptions(background=tiny.BACKGROUND))
    )
    assert built == [16]
    assert seen[0] > 100
    assert require(stored.landmarks).trial.images == len(photos) // 3
    assert stored.bounds.contracted


def test_images_with_silhouettes_are_trained_on_without_landmarks() -> None:
    bare = [replace(v, frame=replace(v.frame, depth=None)) for v in tiny.views(3)]
    tracked, views = track_landmarks(bare)
    assert tracked is None
    assert all(view.landmarks is None for view in views)


# Photos.


def test_a_damaged_record_of_photos_is_named_in_a_line(baked: Path, bidnerf: Run) -> None:
    file = baked / str(load_info(baked).capture)
    for content in ("", "{}", '{"photos": 3}'):
        file.write_text(content)
        assert_refused(bidnerf("info", baked), 1, file.name)
    file.unlink()
    assert_refused(bidnerf("info", baked), 1, file.name, "no such file")


@pytest.mark.usefixtures("_landmarks_only")
def test_photos_of_another_scene_are_not_baked_into_a_map(
    folder: Path, baked: Path, tmp_path: Path, bidnerf: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    tiny.write_dataset(tmp_path / "other", train=9)
    file = tmp_path / "other" / "transforms.json"  # photos from elsewhere, as of another scene
    described = json.loads(file.read_text())
    for number, frame in enumerate(described["frames"]):
        frame["transform_matrix"][0][3] += 0.01 * (1 + number)
    file.write_text(json.dumps(described))
    known = json.loads((baked / "map.json").read_text())
    (baked / "map.json").write_text(json.dumps(known | {"colour_noise": 0.1}))
    before = {file.name: file.read_bytes() for file in baked.iterdir()}
    monkeypatch.setattr("bidnerf_core.maps.map.colour_noise", lambda *_: 0.31)
    for never_baked_or_baked in (folder, baked):
        refused = bidnerf("bake", never_baked_or_baked, "--data", tmp_path / "other")
        assert_refused(refused, 1, "differ from the photos", "by 31%")
    assert {file.name: file.read_bytes() for file in baked.iterdir()} == before
    monkeypatch.setattr("bidnerf_core.maps.map.colour_noise", lambda *_: 0.15)  # of the same scene
    assert bidnerf("bake", baked, "--data", tmp_path / "other").status == 0
