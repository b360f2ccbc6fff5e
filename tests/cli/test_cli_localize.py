"""``bidnerf localize`` with photos, folders and whole splits; names on the terminal."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any, NoReturn

import imageio.v3 as iio
import numpy as np
import pytest
import torch

import tiny
from bidnerf import SE3, Localizer

# Inside: the starts of --perturb and the arguments QUERY, without a localization of each
from bidnerf.cli.localize import StartOptions
from bidnerf.cli.options import TEST_IMAGES, QueryOptions
from bidnerf.results import pose_error
from bidnerf.testing import unseen
from bidnerf_core.datasets import Photos, Query, open_dataset
from bidnerf_core.errors import InputError, printable
from bidnerf_core.localization import Outcome
from bidnerf_core.mapping import BakeConfig
from bidnerf_core.maps import load_info
from bombs import png_of
from commands import Run, assert_refused
from stored_ground import open_ground

FOCAL = ["--focal", tiny.CAMERA.fx]
QUICK = ["--method", "bid", "--max-steps", "2", "--rays", "64"]


@pytest.fixture(scope="module")
def given(shared: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Test images of the dataset as ``photos`` in a folder with other files, their ``depth``, and a ``start.json``."""
    folder = tmp_path_factory.mktemp("localize")
    (folder / "photos").mkdir()
    (folder / "depth").mkdir()
    for name in ("t_0000", "t_0001", "t_0002"):
        shutil.copy(shared / f"data/images/{name}.png", folder / "photos")
        shutil.copy(shared / f"data/depth/{name}.png", folder / f"depth/{name}.depth.png")
    (folder / "photos/notes.txt").write_text("x")
    pose = open_dataset(shared / "data").views("test")[0].T_ref_camera.matrix().tolist()
    (folder / "start.json").write_text(json.dumps({"T_world_camera": pose}))
    return folder


@pytest.fixture
def place(shared: Path, given: Path) -> list[Any]:
    """The arguments by which photos are localized quickly; QUERY comes after them."""
    return ["localize", *QUICK, "--start", given / "start.json", shared / "map"]


def objects(out: str) -> list[dict[str, Any]]:
    return [json.loads(line) for line in out.splitlines()]


# Photos.


def test_a_folder_of_photos_is_localized_in_one_run(
    bidnerf: Run, given: Path, place: list[Any], tmp_path: Path
) -> None:
    _, out, err = bidnerf(*place, given / "photos", *FOCAL, "--json", "--draw", tmp_path).succeed()
    found = objects(out)
    assert [each["frame"] for each in found] == ["t_0000", "t_0001", "t_0002"]
    assert all(each["error"] is None and each["method"] == "bid" for each in found)
    assert err.count("focal length 32 px, as given") == 1  # the same camera is reported once
    assert err.count("skipped notes.txt") == 1
    assert "of 3 accepted" in err
    names = sorted(file.name for file in tmp_path.iterdir())
    assert names == [f"overlay-t_000{i}.png" for i in range(3)]
    pictures = [iio.imread(tmp_path / name) for name in names]
    assert all(picture.shape == pictures[0].shape and picture.std() > 10 for picture in pictures)
    assert not np.array_equal(pictures[0], pictures[1])


def test_a_photo_has_no_error_since_it_has_no_truth(bidnerf: Run, given: Path, place: list[Any]) -> None:
    out = bidnerf(*place, given / "photos/t_0001.png", *FOCAL).succeed().out
    assert out.startswith("t_0001: ")
    assert "error" not in out
    assert out.splitlines()[-5].startswith("  T_world_camera (camera axes x right")


def test_an_answer_without_a_pose_shows_no_numbers(
    bidnerf: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    open_ground(monkeypatch)
    (tmp_path / "black.png").write_bytes(png_of(128, 96))
    words = ["localize", "MAP", tmp_path / "black.png", "--focal", 130]
    first, *more = bidnerf(*words).succeed().out.splitlines()
    assert first.startswith("black: refused: ")
    assert more == ["  no pose, since nothing was recognised"]
    (found,) = objects(bidnerf(*words, "--json").succeed().out)
    assert (found["T_world_camera"], found["converged"]) == (None, False)


def test_depth_that_is_missing_or_without_a_measurement_is_told(
    bidnerf: Run, given: Path, place: list[Any], tmp_path: Path
) -> None:
    empty = tmp_path / "t_0001.npy"
    np.save(empty, np.zeros((24, 24), dtype=np.uint16))
    err = bidnerf(*place, given / "photos/t_0001.png", *FOCAL, "--depth", empty).err
    assert "the depth image holds no measurement, so only colour is used" in err
    photos = [given / "photos" / f"{name}.png" for name in ("t_0000", "t_0001")]
    err = bidnerf(*place, *photos, *FOCAL, "--depth", given / "depth/t_0000.depth.png").succeed().err
    assert "t_0001: no measured depth was given; colour only" in err
    assert "t_0000: no measured depth" not in err


def test_an_answer_is_the_same_alone_among_others_and_as_a_frame(
    bidnerf: Run, shared: Path, given: Path, place: list[Any]
) -> None:
    depth, unit = sorted((given / "depth").iterdir()), ["--depth-unit", "0.001"]
    photo = [*place, given / "photos/t_0001.png", *FOCAL, "--json"]
    together = objects(bidnerf(*place, given / "photos", *FOCAL, "--json", "--depth", *depth, *unit).out)[1]
    (alone,) = objects(bidnerf(*photo, "--depth", depth[1], *unit).out)
    (frame,) = objects(bidnerf(*place, shared / "data", "--frame", "t_0001", "--json").out)
    assert together["T_world_camera"] == alone["T_world_camera"]
    assert np.allclose(alone["T_world_camera"], frame["T_world_camera"], atol=1e-9)
    (without,) = objects(bidnerf(*photo).out)
    assert without["loss"] != alone["loss"]


def test_a_broken_photo_does_not_stop_the_others(bidnerf: Run, given: Path, place: list[Any], tmp_path: Path) -> None:
    photos = Path(shutil.copytree(given / "photos", tmp_path / "photos"))
    (photos / "t_0001.png").write_bytes((photos / "t_0001.png").read_bytes()[:80])
    status, out, err = bidnerf(*place, photos, *FOCAL, "--json", "--out", tmp_path / "poses.json")
    assert status == 1
    good, bad, last = objects(out)
    assert (bad["frame"], bad["T_world_camera"], bad["converged"]) == ("t_0001", None, False)
    assert good.keys() == bad.keys() == last.keys()
    assert good["T_world_camera"] is not None
    assert last["T_world_camera"] is not None
    assert [line for line in err.splitlines() if line.startswith("t_0001: ") and "t_0001.png" in line]
    assert err.splitlines()[-1].startswith("bidnerf localize: 1 of 3 queries")
    assert json.loads((tmp_path / "poses.json").read_text()) == [good, bad, last]


# Datasets.


def test_each_frame_of_a_split_or_of_all_is_a_query(bidnerf: Run, shared: Path, place: list[Any]) -> None:
    split = ["localize", shared / "map", shared / "data", *QUICK, "--perturb", "0.1", "5"]
    out = bidnerf(*split, "--json").succeed().out
    found = objects(out)
    assert [each["frame"] for each in found] == ["t_0000", "t_0001", "t_0002"]
    assert all(each["error"]["translation"] > 0 for each in found)
    assert len(bidnerf(*split).out.splitlines()) == 3
    everything = bidnerf(*place, shared / "data", "--split", "all", "--json")
    assert len(objects(everything.out)) == 9, everything.err


def test_each_frame_is_moved_in_a_direction_of_its_own() -> None:
    view = unseen()
    start_of = StartOptions(perturb=(0.1, 5.0), seed=3).of_queries()
    first, second, again = (start_of(Query(name, (view,), view.T_ref_camera)) for name in ("a", "b", "a"))
    assert isinstance(first, SE3)
    assert isinstance(second, SE3)
    for start in (first, second):
        error = pose_error(start, view.T_ref_camera)
        assert (float(error.translation), float(error.rotation_deg)) == pytest.approx((0.1, 5.0))
    assert isinstance(again, SE3)
    assert torch.equal(first.matrix(), again.matrix())
    assert float((first.translation - second.translation).norm()) > 0.01


# Files of poses.


def test_files_of_poses_hold_what_converged(
    bidnerf: Run, given: Path, place: list[Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    answer = Localizer.__call__
    monkeypatch.setattr(
        Localizer, "__call__", lambda *a, **more: replace(answer(*a, **more), outcome=Outcome.CONVERGED)
    )
    sure = [*place, given / "photos", *FOCAL, "--json"]
    found = objects(bidnerf(*sure, "--out", tmp_path / "poses.tum").out)
    rows = np.loadtxt(tmp_path / "poses.tum")
    positions = [[row[3] for row in each["T_world_camera"][:3]] for each in found]
    np.testing.assert_allclose(rows[:, 1:4], positions, atol=1e-9)
    assert bidnerf(*sure, "--out", tmp_path / "my_transforms.json").status == 0
    (tmp_path / "my_transforms.json").rename(tmp_path / "transforms.json")
    dataset = open_dataset(tmp_path)
    read = {view.frame.name: view for split in dataset.splits for view in dataset.views(split)}
    assert sorted(read) == [each["frame"] for each in found]
    for each in found:
        matrix = torch.tensor(each["T_world_camera"], dtype=torch.float64)
        assert torch.allclose(read[each["frame"]].T_ref_camera.matrix(), matrix, atol=1e-9)
        assert read[each["frame"]].frame.intrinsics == tiny.CAMERA


def test_answers_to_several_photos_say_how_to_get_their_poses(bidnerf: Run, given: Path, place: list[Any]) -> None:
    _, out, err = bidnerf(*place, given / "photos", *FOCAL).succeed()
    assert [line.partition(":")[0] for line in out.splitlines()] == ["t_0000", "t_0001", "t_0002"]
    assert "of 3 accepted; --out poses.json writes all poses" in err


def test_without_an_accepted_pose_no_file_is_written(
    bidnerf: Run, given: Path, place: list[Any], tmp_path: Path
) -> None:
    doubtful = [*place, given / "photos", *FOCAL, "--converged-loss", "0"]
    status, _, err = bidnerf(*doubtful, "--out", tmp_path / "poses.txt")
    assert status == 1
    assert "no pose was accepted" in err
    assert "0 of 3 accepted" in err
    assert list(tmp_path.iterdir()) == []
    assert bidnerf(*doubtful, "--out", tmp_path / "none" / "poses.txt").status == 1


@pytest.mark.parametrize(("name", "kept"), [("found.json", True), ("found.txt", False), (None, False)])
def test_an_interrupted_run_keeps_its_answers(
    bidnerf: Run,
    given: Path,
    place: list[Any],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    name: str | None,
    kept: bool,
) -> None:
    """Two of the three photos are answered; two steps from a start do not converge, so a trajectory would be empty."""

    def stopping(photos: Photos, place: int) -> Query:
        if place == 2:
            raise KeyboardInterrupt
        return read(photos, place)

    read = Photos.read
    monkeypatch.setattr(Photos, "read", stopping)
    out = [] if name is None else ["--out", tmp_path / name]
    status, _, err = bidnerf(*place, given / "photos", *FOCAL, *out)
    assert status == 130
    assert [file.name for file in tmp_path.iterdir()] == ([name] if kept else [])
    if kept and name:
        assert f"{name}: written after 2 of 3 images" in err
        found = json.loads((tmp_path / name).read_text())
        assert [each["frame"] for each in found] == ["t_0000", "t_0001"]


# Maps and names.


def test_a_map_that_was_not_baked_is_baked_by_resume(
    bidnerf: Run, shared: Path, map_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("bidnerf_core.maps.training.USUAL_BAKE", BakeConfig(cells=5000))
    before = load_info(map_folder)
    assert before.surface is None
    resume = ["train", shared / "data", "--out", map_folder, "--resume"]
    err = bidnerf(*resume).succeed().err
    assert "training:" not in err
    assert load_info(map_folder).surface is not None
    assert load_info(map_folder).weights == before.weights
    assert_refused(bidnerf(*resume), 1, "and baked, nothing to resume")


def test_names_cannot_control_the_terminal(bidnerf: Run, map_folder: Path, tmp_path: Path) -> None:
    assert printable("naïve 名 é") == "naïve 名 é"
    assert printable("a\x1b[31m\x00\u202e\udc80\x9b") == "a\\x1b[31m\\x00\\u202e\\udc80\\x9b"
    out = map_folder.rename(tmp_path / "a\x1b]0;x\x07b")
    description = json.loads((out / "map.json").read_text())
    (out / "map.json").write_text(json.dumps(description | {"data": "\x1b[2J"}))
    for words in (["info", out], ["info", tmp_path / "\x1b[2Jnone"]):
        _, said, err = bidnerf(*words)
        assert "\x1b" not in said + err
        assert "\\x1b" in said + err


def test_a_photo_that_cannot_be_opened_does_not_stop_the_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files = [tmp_path / "a.png", tmp_path / "b.png"]
    for file in files:
        file.write_bytes(png_of(64, 48))

    def deny(path: Path, what: str) -> NoReturn:
        raise InputError("permission denied", where=path)

    monkeypatch.setattr("bidnerf_core.io.open_binary", deny)
    photos = QueryOptions().opener(files, TEST_IMAGES)([], None)
    assert list(photos.names) == ["a", "b"]
