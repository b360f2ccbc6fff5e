"""COLMAP models on the command line: depth for training and for localization, and what is said of it."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

import sparse_model
import tiny
from bidnerf_core.cli import main
from bidnerf_core.datasets import open_dataset
from bidnerf_core.evaluation import grouped, read_results
from bidnerf_core.maps import load_info
from commands import CommandResult, Run
from test_cli import stop_at

QUICK = ["--method", "bid", "--perturb", "0.1", "5", "--max-steps", "3", "--rays", "64", "--json"]


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """``data`` without depth, ``sparse`` of its training and test images, ``map`` trained with its points."""
    folder = tmp_path_factory.mktemp("colmap")
    dense = open_dataset(tiny.write_dataset(folder / "dense"))
    views = [view for split in ("train", "test") for view in dense.views(split)]
    sparse_model.write(folder / "sparse", sparse_model.known(views, [f"{v.frame.name}.png" for v in views]))
    tiny.write_dataset(folder / "data", depth=False)
    train = ["train", folder / "data", "--out", folder / "map", "--depth-points", folder / "sparse"]
    assert main([*map(str, train), *tiny.options()]) == 0
    return folder


def assert_refused(outcome: CommandResult, status: int, *fragments: str) -> None:
    assert (outcome.status, outcome.out) == (status, "")
    assert outcome.err.count("\n") == 1, outcome.err
    assert all(fragment in outcome.err for fragment in fragments), outcome.err


def assert_refused_last(outcome: CommandResult, *fragments: str) -> None:
    """Assert that a run was refused in its last line; other lines may stand before it."""
    assert (outcome.status, outcome.out) == (1, "")
    assert all(fragment in outcome.err.splitlines()[-1] for fragment in fragments), outcome.err


def test_training_takes_depth_from_the_points(bidnerf: Run, shared: Path, tmp_path: Path) -> None:
    train = ["train", shared / "data", *tiny.options()]
    found = bidnerf(*train, "--out", tmp_path / "map", "--depth-points", shared / "sparse")
    assert found.status == 0
    assert "its unit is 0.37 m according to 6 training cameras, positions agree" in found.err
    info = load_info(tmp_path / "map")
    assert info.sparse_depth > 30
    assert f"depth at {info.sparse_depth} pixels of 6 of 6 images" in found.err
    assert "colour only" not in found.err
    fewer = bidnerf(
        *train, "--out", tmp_path / "fewer", "--depth-points", shared / "sparse", "--points-views", 4
    )
    assert fewer.status == 0
    assert 0 < load_info(tmp_path / "fewer").sparse_depth < info.sparse_depth


def test_images_with_depth_of_their_own_keep_it(bidnerf: Run, shared: Path, tmp_path: Path) -> None:
    train = ["train", shared / "dense", "--out", tmp_path / "map", *tiny.options()]
    assert_refused(bidnerf(*train, "--depth-points", shared / "sparse"), 1, "gives no depth to split 'train'")
    assert not (tmp_path / "map").exists()


def test_a_training_is_resumed_with_the_depth_that_it_began_with(
    bidnerf: Run, shared: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stop_at(monkeypatch, 5)
    train = ["train", shared / "data", "--out", tmp_path / "map", *tiny.options()]
    points = ["--depth-points", shared / "sparse"]
    assert bidnerf(*train, *points).status == 130
    monkeypatch.undo()
    refused = bidnerf(*train, "--resume")
    assert_refused(refused, 2, "resuming keeps the points (--depth-points)", "got 0")
    assert bidnerf(*train, *points, "--resume").status == 0


def test_localization_takes_the_points_that_the_frames_observe(bidnerf: Run, shared: Path) -> None:
    place = ["localize", shared / "map", shared / "data", *QUICK, "--frame", "t_0001", "--window", 2]
    without, with_points = bidnerf(*place), bidnerf(*place, "--depth-points", shared / "sparse")
    assert (without.status, with_points.status) == (0, 0)
    assert json.loads(without.out)["loss"] != json.loads(with_points.out)["loss"]
    assert "its unit is 0.37 m according to 6 training cameras" in with_points.err
    assert "points seen" in with_points.err
    assert "none by" not in with_points.err


def test_with_a_surface_the_points_take_the_place_of_a_start(
    bidnerf: Run, shared: Path, tmp_path: Path
) -> None:
    folder = Path(shutil.copytree(shared / "map", tmp_path / "map"))
    frames = ["--frame", "t_0002", "--window", 3, "--no-start", "--json"]
    place = ["localize", folder, shared / "data", *frames]
    points = ["--depth-points", shared / "sparse"]
    assert_refused_last(bidnerf(*place, *points), "needs a start")
    assert bidnerf("bake", folder, "--data", shared / "dense").status == 0
    found = bidnerf(*place, *points)
    assert found.status == 0
    assert json.loads(found.out)["method"] == "auto"
    assert "colour only" not in found.err


@pytest.mark.parametrize("method", ["inerf", "inerf-lm"])
def test_methods_of_colour_alone_refuse_them(method: str, bidnerf: Run, shared: Path, tmp_path: Path) -> None:
    options = ["--method", method, "--depth-points", shared / "sparse"]
    place = ["localize", shared / "map", shared / "data", "--frame", "t_0001", "--perturb", 0.1, 5]
    assert_refused(
        bidnerf(*place, *options), 1, f"method '{method}' uses colour alone", "'auto' or 'bid' or 'bid-lm'"
    )
    bench = ["evaluate", shared / "map", shared / "data", "--out", tmp_path / "r.jsonl", "--trials", 1]
    assert_refused_last(bidnerf(*bench, *options), f"method '{method}' uses colour alone")


def test_a_bench_takes_them_too(bidnerf: Run, shared: Path, tmp_path: Path) -> None:
    out, points = tmp_path / "r.jsonl", ["--depth-points", shared / "sparse"]
    bench = [
        "evaluate",
        shared / "map",
        shared / "data",
        "--out",
        out,
        "--trials",
        2,
        "--size",
        0.5,
        "--workers",
        1,
    ]
    bench += ["--method", "bid", "--max-steps", 2, "--rays", 32]
    assert bidnerf(*bench).status == 0
    assert bidnerf(*bench, *points).status == 0
    again = bidnerf(*bench, *points)
    assert "2 of 2 trials are already there" in again.err
    found = read_results([out])
    assert [result.trial.depth_points for result in found[:2]] == [None, None]
    assert all(str(result.trial.depth_points).endswith("/sparse") for result in found[2:])
    assert found[0].loss != found[2].loss
    assert found[0].start_error == found[2].start_error
    labels = {group.label for group in grouped(found)}
    assert any("no points" in label for label in labels)
    assert any("points of" in label for label in labels)
    known = sparse_model.known(
        open_dataset(shared / "dense").views("train"), [f"r_000{i}.png" for i in range(6)]
    )
    training = sparse_model.write(tmp_path / "training", known)
    refused = bidnerf(*bench, "--depth-points", training)
    assert_refused(refused, 1, "no points for 2 of 2 frames (t_0002,", "choose others with --frame")
    assert_refused(
        bidnerf("evaluate", "demo:blobs", "--out", tmp_path / "x", *points), 1, "no training cameras"
    )


def test_a_model_that_is_of_no_use_is_told_in_a_line(bidnerf: Run, shared: Path, tmp_path: Path) -> None:
    place = ["localize", shared / "map", shared / "data", *QUICK, "--frame", "t_0001"]
    assert_refused(bidnerf(*place, "--depth-points", shared / "data"), 1, "no COLMAP sparse model in it")
    assert_refused(bidnerf(*place, "--depth-points", shared), 1, "did you mean", str(shared / "sparse"))
    views = open_dataset(shared / "dense").views("train")
    names = [f"{view.frame.name}.png" for view in views]
    training = sparse_model.write(tmp_path / "training", sparse_model.known(views, names))
    # The model is summarized once, whatever frames follow.
    assert_refused_last(
        bidnerf(*place, "--depth-points", training), "no points observed by t_0001", "6 images"
    )
    strangers = sparse_model.write(
        tmp_path / "strangers", sparse_model.known(views, [f"x{n}" for n in names])
    )
    assert_refused(bidnerf(*place, "--depth-points", strangers), 1, "has 0 of the 6 training cameras")
