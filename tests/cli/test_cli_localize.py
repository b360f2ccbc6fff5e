"""``bidnerf localize`` with photos, folders and whole splits; lazy imports, help pages, locks and names on the terminal."""

from __future__ import annotations

import dataclasses
import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Annotated, Any

import imageio.v3 as iio
import numpy as np
import pytest
import torch

import tiny
from bidnerf_core.cli import main
from bidnerf_core.cli.help_page import without_expert_settings
from bidnerf_core.cli.options import parse
from bidnerf_core.datasets import Photos, Query, open_dataset
from bidnerf_core.errors import printable
from bidnerf_core.io import output_folder
from bidnerf_core.localization import Outcome, Verdict
from bidnerf_core.maps import load_info
from bidnerf_core.settings import EXPERT, Settings
from commands import Run

FOCAL = ["--focal", tiny.CAMERA.fx]
QUICK = ["--method", "bid", "--max-steps", "2", "--rays", "64"]


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset, a map of it, its test images as photos in a folder with other files, their depth, and a start."""
    folder = tmp_path_factory.mktemp("localize")
    tiny.write_dataset(folder / "data")
    assert main(["train", str(folder / "data"), "--out", str(folder / "map"), *tiny.options()]) == 0
    (folder / "photos").mkdir()
    (folder / "depth").mkdir()
    for name in ("t_0000", "t_0001", "t_0002"):
        shutil.copy(folder / f"data/images/{name}.png", folder / "photos")
        shutil.copy(folder / f"data/depth/{name}.png", folder / f"depth/{name}.depth.png")
    (folder / "photos/notes.txt").write_text("x")
    pose = open_dataset(folder / "data").views("test")[0].T_ref_camera.matrix().tolist()
    (folder / "start.json").write_text(json.dumps({"T_world_camera": pose}))
    return folder


@pytest.fixture
def place(shared: Path) -> list[object]:
    """The arguments by which photos are localized quickly; QUERY comes after them."""
    return ["localize", *QUICK, "--start", shared / "start.json", shared / "map"]


def objects(out: str) -> list[dict[str, Any]]:
    return [json.loads(line) for line in out.splitlines()]


# Photos.


def test_a_folder_of_photos_is_localized_in_one_run(bidnerf: Run, shared: Path, place: list[object]) -> None:
    status, out, err = bidnerf(*place, shared / "photos", *FOCAL, "--json")
    assert status == 0, err
    found = objects(out)
    assert [each["frame"] for each in found] == ["t_0000", "t_0001", "t_0002"]
    assert all(each["error"] is None and each["method"] == "bid" for each in found)
    assert err.count("focal length 32 px, as given") == 1  # the same camera is reported once
    assert err.count("skipped notes.txt") == 1
    assert "of 3 converged" in err


def test_a_photo_has_no_error_since_it_has_no_truth(bidnerf: Run, shared: Path, place: list[object]) -> None:
    status, out, _ = bidnerf(*place, shared / "photos/t_0001.png", *FOCAL)
    assert status == 0
    assert out.startswith("t_0001: ")
    assert "error" not in out
    assert out.splitlines()[-5].startswith("  T_world_camera (camera axes x right")


def test_depth_without_a_measurement_is_told(
    bidnerf: Run, shared: Path, place: list[object], tmp_path: Path
) -> None:
    empty = tmp_path / "t_0001.npy"
    np.save(empty, np.zeros((24, 24), dtype=np.uint16))
    err = bidnerf(*place, shared / "photos/t_0001.png", *FOCAL, "--depth", empty)[2]
    assert "the depth image holds no measurement, so only colour is used" in err


def test_an_answer_is_the_same_alone_among_others_and_as_a_frame(
    bidnerf: Run, shared: Path, place: list[object]
) -> None:
    depth = ["--depth", *sorted((shared / "depth").iterdir()), "--depth-unit", "0.001"]
    together = objects(bidnerf(*place, shared / "photos", *FOCAL, "--json", *depth)[1])[1]
    alone = objects(
        bidnerf(*place, shared / "photos/t_0001.png", *FOCAL, "--json", *depth[:1], depth[2], *depth[4:])[1]
    )[0]
    frame = objects(bidnerf(*place, shared / "data", "--frame", "t_0001", "--json")[1])[0]
    assert together["T_world_camera"] == alone["T_world_camera"]
    assert np.allclose(alone["T_world_camera"], frame["T_world_camera"], atol=1e-9)
    without = objects(bidnerf(*place, shared / "photos/t_0001.png", *FOCAL, "--json")[1])[0]
    assert without["loss"] != alone["loss"]


def test_a_broken_photo_does_not_stop_the_others(
    bidnerf: Run, shared: Path, place: list[object], tmp_path: Path
) -> None:
    photos = Path(shutil.copytree(shared / "photos", tmp_path / "photos"))
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


def test_a_photo_without_a_camera_is_refused_in_a_line(
    bidnerf: Run, shared: Path, place: list[object]
) -> None:
    status, out, err = bidnerf(*place, shared / "photos/t_0001.png")
    assert (status, out, err.count("\n")) == (1, "", 1)
    assert "no focal length in EXIF" in err


@pytest.mark.parametrize("command", ["localize", "view", "evaluate"])
def test_a_frame_of_another_split_is_told_where_it_is(
    bidnerf: Run, shared: Path, tmp_path: Path, command: str
) -> None:
    name = open_dataset(shared / "data").frame_names("train")[0]
    out = {"view": ["--save", tmp_path / "page.html"], "evaluate": ["--out", tmp_path / "r.jsonl"]}
    found = bidnerf(command, shared / "map", shared / "data", "--frame", name, *out.get(command, []))
    assert found.status == 1
    assert f"no frame {name!r}, which is in split 'train'; choose that split" in found.err


def test_all_splits_of_a_dataset_are_localized(bidnerf: Run, shared: Path, tmp_path: Path) -> None:
    words = [
        "localize",
        *QUICK,
        "--start",
        shared / "start.json",
        shared / "map",
        shared / "data",
        "--split",
        "all",
    ]
    found = bidnerf(*words, "--json", "--out", tmp_path / "transforms.json")
    dataset = open_dataset(shared / "data")
    count = sum(len(dataset.frame_names(split)) for split in dataset.splits)
    assert len(objects(found.out)) == count, found.err


def test_arguments_in_another_order_are_told_apart(
    bidnerf: Run, shared: Path, place: list[object], tmp_path: Path
) -> None:
    swapped = bidnerf("localize", shared / "photos", shared / "map")
    assert swapped.status == 2
    assert f"'{shared / 'photos'}' is not a map, but '{shared / 'map'}' is: MAP comes first" in swapped.err
    shutil.copytree(shared / "map", tmp_path / "other")
    maps = bidnerf("localize", shared / "map", tmp_path / "other")
    assert maps.status == 2
    assert f"'{shared / 'map'}' and '{tmp_path / 'other'}' are maps, and no QUERY follows them" in maps.err
    status, _, err = bidnerf(*place, shared / "data" / "transforms.json")
    assert status == 1
    assert f"transforms.json: is a file of a dataset; give its folder, {shared / 'data'}" in err


def test_a_folder_without_photos_is_refused(bidnerf: Run, place: list[object], tmp_path: Path) -> None:
    status, out, err = bidnerf(*place, tmp_path)
    assert (status, out) == (1, "")
    assert "the folder is empty" in err


# Datasets.


def test_without_names_each_frame_of_the_split_is_a_query(bidnerf: Run, shared: Path) -> None:
    status, out, _ = bidnerf(
        "localize", shared / "map", shared / "data", *QUICK, "--perturb", "0.1", "5", "--json"
    )
    assert status == 0
    each = objects(out)
    assert [found["frame"] for found in each] == ["t_0000", "t_0001", "t_0002"]
    assert all(found["error"]["translation"] > 0 for found in each)
    listed = bidnerf("localize", shared / "map", shared / "data", *QUICK, "--perturb", "0.1", "5")[1]
    assert len(listed.splitlines()) == 3


# Files of poses, and pictures.


def test_files_of_poses_hold_what_converged(
    bidnerf: Run, shared: Path, place: list[object], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    accepted = Verdict(Outcome.CONVERGED, "whatever it explains")
    monkeypatch.setattr("bidnerf_core.localization.first_order.descent_verdict", lambda *given: accepted)
    sure = [*place, shared / "photos", *FOCAL, "--json"]
    found = objects(bidnerf(*sure, "--out", tmp_path / "poses.tum")[1])
    rows = np.loadtxt(tmp_path / "poses.tum")
    positions = [[row[3] for row in each["T_world_camera"][:3]] for each in found]
    np.testing.assert_allclose(rows[:, 1:4], positions, atol=1e-9)
    assert bidnerf(*sure, "--out", tmp_path / "my_transforms.json")[0] == 0
    (tmp_path / "my_transforms.json").rename(tmp_path / "transforms.json")
    dataset = open_dataset(tmp_path)
    read = {view.frame.name: view for split in dataset.splits for view in dataset.views(split)}
    assert sorted(read) == [each["frame"] for each in found]
    for each in found:
        matrix = torch.tensor(each["T_world_camera"], dtype=torch.float64)
        assert torch.allclose(read[each["frame"]].T_ref_camera.matrix(), matrix, atol=1e-9)
        assert read[each["frame"]].frame.intrinsics == tiny.CAMERA


def test_without_an_accepted_pose_no_file_is_written(
    bidnerf: Run, shared: Path, place: list[object], tmp_path: Path
) -> None:
    doubtful = [*place, shared / "photos", *FOCAL, "--converged-loss", "0"]
    status, _, err = bidnerf(*doubtful, "--out", tmp_path / "poses.txt")
    assert status == 1
    assert "no pose converged" in err
    assert "0 of 3 converged; do they show the scene of this map?" in err
    assert list(tmp_path.iterdir()) == []
    assert bidnerf(*doubtful, "--out", tmp_path / "none" / "poses.txt")[0] == 1


def test_pictures_are_drawn_of_each_query(
    bidnerf: Run, shared: Path, place: list[object], tmp_path: Path
) -> None:
    status, _, err = bidnerf(*place, shared / "photos", *FOCAL, "--draw", tmp_path / "drawn")
    assert status == 0, err
    names = sorted(file.name for file in (tmp_path / "drawn").iterdir())
    assert names == [f"overlay-t_000{i}.png" for i in range(3)]
    pictures = [iio.imread(tmp_path / "drawn" / name) for name in names]
    assert all(picture.shape == pictures[0].shape and picture.std() > 10 for picture in pictures)
    assert not np.array_equal(pictures[0], pictures[1])


# Trained, but not baked; two at once.


def test_a_map_that_was_not_baked_is_baked_by_resume(bidnerf: Run, shared: Path, tmp_path: Path) -> None:
    out = Path(shutil.copytree(shared / "map", tmp_path / "map"))
    assert load_info(out).surface is None
    before = load_info(out).weights
    status, _, err = bidnerf("train", shared / "data", "--out", out, "--resume")
    assert status == 0, err
    assert "training is complete" in err
    assert load_info(out).surface is not None
    assert load_info(out).weights == before
    status, _, err = bidnerf("train", shared / "data", "--out", out, "--resume")
    assert status == 1
    assert "and baked, nothing to resume" in err


def test_a_folder_that_another_process_writes_into_is_refused(
    bidnerf: Run, shared: Path, tmp_path: Path
) -> None:
    out = tmp_path / "map"
    with output_folder(out, overwrite=False):
        status, said, err = bidnerf("train", shared / "data", "--out", out, *tiny.options(2))
        assert (status, said, err.count("\n")) == (1, "", 1)
        assert "another bidnerf process is writing here" in err
        assert out.is_dir()
    assert bidnerf("train", shared / "data", "--out", out, *tiny.options(2))[0] == 0


# Names, help, start.


def test_names_cannot_control_the_terminal(bidnerf: Run, shared: Path, tmp_path: Path) -> None:
    assert printable("naïve 名 é") == "naïve 名 é"
    assert printable("a\x1b[31m\x00\u202e\udc80\x9b") == "a\\x1b[31m\\x00\\u202e\\udc80\\x9b"
    out = Path(shutil.copytree(shared / "map", tmp_path / "a\x1b]0;x\x07b"))
    description = json.loads((out / "map.json").read_text())
    (out / "map.json").write_text(json.dumps(description | {"data": "\x1b[2J"}))
    for words in (["info", out], ["info", tmp_path / "\x1b[2Jnone"]):
        _, said, err = bidnerf(*words)
        assert "\x1b" not in said + err
        assert "\\x1b" in said + err


@dataclasses.dataclass(frozen=True)
class Inner(Settings):
    """What is inside."""

    plain: int = 1  # shown always
    rare: Annotated[int, EXPERT] = 2  # shown to experts


@dataclasses.dataclass(frozen=True)
class Rare(Settings):
    """What only experts touch."""

    first: int = 1  # of two
    second: int = 2  # of two


@dataclasses.dataclass(frozen=True)
class Outer(Settings):
    """What is outside."""

    inner: Inner = Inner()
    group: Annotated[Rare, EXPERT] = Rare()
    other: float = 0.5  # shown, too


def command(config: Outer = Outer()) -> Outer:
    """Take settings."""
    return config


def test_help_hides_what_experts_need(capsys: pytest.CaptureFixture[str]) -> None:
    assert without_expert_settings(command)[1] == 3
    for option in ("--help", "--help-all"):
        with pytest.raises(SystemExit):
            parse("x", command, [option])
        page = capsys.readouterr().out
        assert "--plain" in page
        assert "shown, too" in page
        assert "inner options" in page
        assert "config.inner" not in page
        assert ("--second" in page) == ("--rare" in page) == (option == "--help-all")
        assert ("3 expert settings are not shown; --help-all" in page) == (option == "--help")


def test_experts_settings_are_parsed_though_they_are_not_shown(bidnerf: Run) -> None:
    short, whole = (
        bidnerf("localize", "--method", "bid-lm", "--help")[1],
        bidnerf("localize", "--method", "bid-lm", "--help-all")[1],
    )
    assert "--pivot" not in short
    assert "--pivot" in whole
    status, _, err = bidnerf("localize", "--method", "bid-lm", "--pivot", "camera", "no-map", "no-query")
    assert status == 1
    assert "needs a start" in err


@pytest.mark.parametrize("words", [["--help"], ["--version"], ["backends"], ["frobnicate"]], ids=" ".join)
def test_commands_that_compute_nothing_do_without_torch(words: list[str]) -> None:
    program = (
        "import sys; from bidnerf_core.cli import main; main(sys.argv[1:]);"
        "sys.exit(3 if {'torch', 'numpy', 'kornia'} & set(sys.modules) else 0)"
    )
    done = subprocess.run([sys.executable, "-c", program, *words], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_localizing_imports_nothing_that_only_other_work_needs() -> None:
    program = "import sys, bidnerf_core.cli.localize, bidnerf_core as bn; bn.Localizer, bn.load_map; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    others = {
        "imageio",
        "scipy.optimize",
        "matplotlib",
        "viser",
        "pycolmap",
        "av",
        "jinja2",
        "uvicorn",
        "torch._dynamo",
    }
    assert not others & set(done.stdout.split())


def test_public_names_are_there_and_no_others() -> None:
    import bidnerf_core

    for name in bidnerf_core.__all__:
        assert getattr(bidnerf_core, name) is not None
    assert set(bidnerf_core.__all__) <= set(dir(bidnerf_core))
    with pytest.raises(AttributeError, match="attribute localise"):
        _ = bidnerf_core.localise


@pytest.mark.parametrize(("name", "kept"), [("found.json", True), ("found.txt", False), (None, False)])
def test_an_interrupted_run_keeps_its_answers(
    bidnerf: Run, shared: Path, place: list[object], tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    name: str | None, kept: bool,
) -> None:  # fmt: skip
    """Two of the three photos are answered; two steps from a start do not converge, so a trajectory would be empty."""

    def stopping(photos: Photos, place: int) -> Query:
        if place == 2:
            raise KeyboardInterrupt
        return read(photos, place)

    read = Photos.read
    monkeypatch.setattr(Photos, "read", stopping)
    out = [] if name is None else ["--out", tmp_path / name]
    status, _, err = bidnerf(*place, shared / "photos", *FOCAL, *out)
    assert status == 130
    assert [file.name for file in tmp_path.iterdir()] == ([name] if kept else [])
    if kept and name:
        assert f"{name}: written after 2 of 3 images" in err
        found = json.loads((tmp_path / name).read_text())
        assert [each["frame"] for each in found] == ["t_0000", "t_0001"]


def test_a_photo_without_depth_among_others_is_named(bidnerf: Run, shared: Path, place: list[object]) -> None:
    photos = [shared / "photos" / f"{name}.png" for name in ("t_0000", "t_0001")]
    depth = shared / "depth/t_0000.depth.png"
    status, _, err = bidnerf(*place, *photos, *FOCAL, "--depth", depth)
    assert status == 0, err
    assert "t_0001: no measured depth was given; colour only" in err
    assert "t_0000: no measured depth" not in err
