"""COLMAP models on the command line: depth for training and for localization, and what is said of it."""

from __future__ import annotations

from pathlib import Path

import pytest

import sparse_model
import tiny
from bidnerf_core.datasets import open_dataset
from bidnerf_core.maps import load_info
from commands import Run, assert_refused
from trainings import stop_at

QUICK = ["--method", "bid", "--perturb", "0.1", "5", "--max-steps", "3", "--rays", "64", "--json"]


@pytest.fixture(scope="module")
def given(shared: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """``data`` without depth, and a model of its images, ``sparse``."""
    folder, views = tmp_path_factory.mktemp("colmap"), open_dataset(shared / "data").views("all")
    files = [f"{view.frame.name}.png" for view in views]
    sparse_model.write(folder / "sparse", sparse_model.known(views, files))
    tiny.write_dataset(folder / "data", depth=False)
    return folder


def test_training_takes_depth_from_the_points(bidnerf: Run, given: Path, tmp_path: Path) -> None:
    train = ["train", given / "data", *tiny.options(1), "--depth-points", given / "sparse"]
    found = bidnerf(*train, "--out", tmp_path / "map").succeed()
    assert "its unit is 0.37 m according to 6 training cameras, positions agree" in found.err
    info = load_info(tmp_path / "map")
    assert info.sparse_depth > 30
    assert f"depth at {info.sparse_depth} pixels of 6 of 6 images" in found.err
    assert "colour only" not in found.err
    bidnerf(*train, "--out", tmp_path / "fewer", "--points-views", 4).succeed()
    assert 0 < load_info(tmp_path / "fewer").sparse_depth < info.sparse_depth


def test_images_with_depth_of_their_own_keep_it(bidnerf: Run, shared: Path, given: Path, tmp_path: Path) -> None:
    train = ["train", shared / "data", "--out", tmp_path / "map", *tiny.options()]
    assert_refused(bidnerf(*train, "--depth-points", given / "sparse"), 1, "no depth to split 'train'")
    assert not (tmp_path / "map").exists()


def test_a_training_is_resumed_with_the_depth_that_it_began_with(
    bidnerf: Run, given: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    train = ["train", given / "data", "--out", tmp_path / "map", *tiny.options(4)]
    points = ["--depth-points", given / "sparse"]
    with monkeypatch.context() as patch:
        stop_at(patch, 2)
        assert bidnerf(*train, *points).status == 130
    assert_refused(bidnerf(*train, "--resume"), 2, "--depth-points", "got 0")
    assert bidnerf(*train, *points, "--resume").status == 0
