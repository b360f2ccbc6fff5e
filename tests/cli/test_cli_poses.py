"""``bidnerf train --refine-poses``: what a map keeps of given and refined poses, and who takes which."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

import tiny
from bidnerf import SE3, View
from bidnerf.cli import main
from bidnerf_core.captures import PoseRefinement, TrainingPoses, given_cameras, stored_cameras
from bidnerf_core.captures import prepare_views as prepared_for_training
from bidnerf_core.datasets import DatasetOptions, open_dataset
from bidnerf_core.errors import InputError
from bidnerf_core.mapping import TrackedViews, track_views
from bidnerf_core.maps import cameras_of, load_info, read_part, read_views
from commands import Run, assert_refused
from landmark_scene import Points, ring
from optional import require
from trainings import assert_same_map, stop_at

UPDATE = torch.tensor([0.01, -0.02, 0.0, 0.0, 0.03, 0.0], dtype=torch.float64)


def refine_poses(patch: pytest.MonkeyPatch) -> None:
    """Let refinement turn every camera by the same right update: images of a few pixels have no keypoints for any."""

    def moved(tracked: TrackedViews, views: Sequence[View], *_: Any, **__: Any) -> TrainingPoses:
        pixels = torch.full((len(views),), 0.9, dtype=torch.float64)
        pixels[2] = 1.4
        there = tracked.at(tracked.T_world_camera.retract(UPDATE))
        return TrainingPoses(there, pixels, [1], True, PoseRefinement(0.7, 0.36))

    patch.setattr("bidnerf_core.captures.training_views.training_poses", moved)


@pytest.fixture(scope="module")
def refined(shared: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A map whose training refined the poses."""
    folder = tmp_path_factory.mktemp("refined")
    with pytest.MonkeyPatch.context() as patch:
        refine_poses(patch)
        assert main(["train", str(shared / "data"), "--out", str(folder / "map"), *tiny.options(1)]) == 0
    return folder / "map"


@pytest.fixture(scope="module")
def views(shared: Path) -> list[View]:
    return open_dataset(shared / "data", tiny.BACKGROUND).views("train")


def test_a_map_holds_refined_and_given_poses(bidnerf: Run, refined: Path, views: list[View]) -> None:
    info = load_info(refined)
    assert given_cameras(info.cameras) == stored_cameras(views)
    for view, (_, T) in zip(views, cameras_of(info), strict=True):
        torch.testing.assert_close((view.T_ref_camera.inverse() @ T).log(), UPDATE, rtol=0, atol=1e-9)
    shown = bidnerf("info", refined).out
    assert (
        "amount to 0.60 px in the images, where keypoints alone scatter by 0.36 px; the poses are refined by"
        f" {UPDATE[:3].norm():.3g} and" in shown
    )
    assert f"by the landmarks of the other images: {views[1].frame.name} by" in shown
    facts = json.loads(bidnerf("info", refined, "--json").out)
    assert [moved["name"] for moved in facts["moved"]] == [view.frame.name for view in views]
    assert facts["moved"][2]["pixels"] == 1.4
    assert facts["poses"]["replaced"] == [views[1].frame.name]


def test_never_and_images_without_keypoints_keep_the_given_poses(
    bidnerf: Run, shared: Path, views: list[View], tmp_path: Path
) -> None:
    train = ["train", shared / "data", *tiny.options(1), "--refine-poses"]
    for when in ("never", "auto", "always"):
        found = bidnerf(*train, when, "--out", tmp_path / when).succeed()
        kept = "the poses are kept: refining them takes at least 8 images" in found.err
        assert kept == (when == "always")
        info = load_info(tmp_path / when)
        stored = [replace(camera, file=None) for camera in info.cameras]
        assert stored == list(stored_cameras(views))
        assert info.pose_refinement is None
        assert json.loads(bidnerf("info", tmp_path / when, "--json").out)["moved"] == []


def test_a_resumed_training_takes_the_refined_poses_again(
    bidnerf: Run, shared: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    refine_poses(monkeypatch)
    train = ["train", shared / "data", *tiny.options(8)]
    told = bidnerf(*train, "--out", tmp_path / "whole").succeed()
    assert "the poses are refined by" in told.err
    with monkeypatch.context() as patch:
        stop_at(patch, 5)
        assert bidnerf(*train, "--out", tmp_path / "half").status == 130
    monkeypatch.setattr("bidnerf_core.captures.training_views.training_poses", None)  # it is not called again
    resume = ["train", shared / "data", "--resume", "--out", tmp_path / "half"]
    assert_refused(bidnerf(*resume, "--refine-poses", "never"), 2, "--refine-poses always")
    assert bidnerf(*resume, "--no-bake").status == 0
    assert_same_map(tmp_path / "half", tmp_path / "whole")
    assert load_info(tmp_path / "half").cameras == load_info(tmp_path / "whole").cameras


def test_photos_that_are_baked_later_have_the_refined_poses(
    bidnerf: Run, shared: Path, refined: Path, tmp_path: Path
) -> None:
    out = Path(shutil.copytree(refined, tmp_path / "map"))
    assert bidnerf("bake", out, "--data", shared / "data", "--measured", 5000, "--cells", 5000).status == 0
    info = load_info(out)
    capture = require(read_part(out, info, "capture"))
    photos = capture.photos
    for photo, (_, T) in zip(photos, cameras_of(info), strict=True):
        torch.testing.assert_close(torch.tensor(photo.position).double(), T.translation, rtol=0, atol=1e-6)


def test_a_damaged_given_pose_is_named(bidnerf: Run, refined: Path, tmp_path: Path) -> None:
    file = Path(shutil.copytree(refined, tmp_path / "map")) / "map.json"
    described = json.loads(file.read_text())
    described["cameras"][1]["given_T_world_camera"][0] = [0, 0, 0, 0]
    file.write_text(json.dumps(described))
    assert_refused(bidnerf("info", tmp_path / "map"), 1, file, described["cameras"][1]["name"], "rigid")


def prepare_views(views: list[View], points: Points, monkeypatch: pytest.MonkeyPatch) -> None:
    """Prepare views of points for training, as the command does."""
    monkeypatch.setattr(
        "bidnerf_core.captures.training_views.track_views",
        lambda given, features, **options: track_views(given, points, **options),
    )
    prepared_for_training(views)


@pytest.mark.slow
def test_a_training_checks_axes_and_units_of_depth(monkeypatch: pytest.MonkeyPatch) -> None:
    points = Points(noise=0.3)
    views = ring(points, 14, depth=1.0)
    prepare_views(views, points, monkeypatch)
    reversed_axes = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
    flipped = [
        replace(v, T_ref_camera=SE3(v.T_ref_camera.rotation @ reversed_axes, v.T_ref_camera.translation)) for v in views
    ]
    with pytest.raises(InputError, match="the poses contradict the photos"):
        prepare_views(flipped, points, monkeypatch)
    millimetres = ring(points, 14, depth=1000.0)
    with pytest.raises(InputError, match="depth_unit_scale_factor"):
        prepare_views(millimetres, points, monkeypatch)


def test_datasets_tell_the_unit_of_their_depth(shared: Path) -> None:
    assert read_views(shared / "data").depth_unit == 0.001
    centimetres = DatasetOptions(split="all", depth_unit=0.01)
    assert read_views(shared / "data", centimetres).depth_unit == 0.01


@pytest.mark.data
@pytest.mark.slow
def test_training_refuses_axes_of_other_software(bidnerf: Run, data_dir: Path, tmp_path: Path) -> None:
    source = data_dir / "room_living"
    described = json.loads((source / "transforms_train.json").read_text())
    described["frames"] = described["frames"][:12]
    for frame in described["frames"]:
        frame["transform_matrix"] = [[a, -b, -c, d] for a, b, c, d in frame["transform_matrix"]]
        for key in ("file_path", "depth_file_path"):
            frame[key] = str(source / frame[key])
    (tmp_path / "data").mkdir()
    (tmp_path / "data/transforms_train.json").write_text(json.dumps(described))
    found = bidnerf("train", tmp_path / "data", "--out", tmp_path / "map", *tiny.options(2))
    named = ("the poses contradict the photos", "diag(1, -1, -1, 1)")
    assert_refused(found, 1, *named, after_remarks=True)
    assert not (tmp_path / "map/map.json").exists()
