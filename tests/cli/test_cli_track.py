"""``bidnerf track``: files of poses, and the summary."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest

from bidnerf import View
from bidnerf.testing import GROUND_CAMERA
from bidnerf_core.captures import stored_cameras
from bidnerf_core.datasets import open_dataset, read_trajectory, write_transforms
from commands import Run, assert_refused
from flights import covered, flight
from stored_ground import open_ground, write_flight

FRAMES = 6


@pytest.fixture(autouse=True)
def _stored(monkeypatch: pytest.MonkeyPatch) -> None:
    open_ground(monkeypatch)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six frames, of which the fourth was taken with the lens cap on."""
    frames = [(covered(f) if n == 3 else f, T) for n, (_, f, T) in enumerate(flight()[:FRAMES])]
    return write_flight(tmp_path_factory.mktemp("track") / "data", frames)


def test_accepted_poses_are_written_as_a_trajectory_and_drawn(bidnerf: Run, data: Path, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    _, out, err = bidnerf("track", "MAP", data, "--out", tmp_path / "p.txt", "--plot", tmp_path / "p.png").succeed()
    path = read_trajectory(tmp_path / "p.txt")
    assert path.times.tolist() == pytest.approx([n / 30 for n in (0, 1, 2, 4, 5)], abs=1e-6)
    truth = [T for _, _, T in flight()[:FRAMES]]
    for place, number in enumerate((0, 1, 2, 4, 5)):
        assert float((path.translations[place] - truth[number].translation).norm()) < 0.045
    for word in ("frames", "tracked", "raw error", "ATE", "RPE", "inside 95 % bound", "5 (83.3%)"):
        assert word in out
    assert "training" not in out
    assert "tracking again after 1 frame" in err
    assert (tmp_path / "p.png").read_bytes().startswith(b"\x89PNG")


def test_frames_that_trained_the_map_are_counted(
    bidnerf: Run, data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The third camera has the name of a frame, but another pose."""
    views = open_dataset(data).views("test")
    elsewhere = stored_cameras([replace(views[2], T_ref_camera=views[1].T_ref_camera)])
    open_ground(monkeypatch, cameras=(*stored_cameras(views[:2]), *elsewhere))
    found = bidnerf("track", "MAP", data, "--out", tmp_path / "path.txt", "--every", 2)
    assert "1 frame; errors on training frames of the map are no test" in found.out


def test_images_without_a_focal_length_begin_with_the_camera_of_the_map(
    bidnerf: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    images = tmp_path / "images"
    open_ground(monkeypatch, assumed=(GROUND_CAMERA,))
    images.mkdir()
    for number, (_, frame, _) in enumerate(flight()[:3]):
        iio.imwrite(images / f"{number}.png", (255 * frame.rgb).round().byte().numpy())
    err = bidnerf("track", "MAP", images, "--out", tmp_path / "path.json").succeed().err
    assert err.count("assumed to be that of the map's images") == 1
    for row, (_, _, T) in zip(json.loads((tmp_path / "path.json").read_text()), flight()[:3], strict=True):
        assert row["converged"]
        assert np.linalg.norm(np.array(row["T_world_camera"])[:3, 3] - T.translation.numpy()) < 0.05


def test_a_file_that_cannot_be_read_is_left_out(bidnerf: Run, tmp_path: Path) -> None:
    """The poses of the others keep their times, which are assumed where a sequence has none."""
    frames = [(replace(f, name=f"at{n}", depth=None), T) for n, (_, f, T) in enumerate(flight()[:FRAMES])]
    broken = write_flight(tmp_path / "data", frames)
    images = sorted(broken.rglob("*.png"))
    assert len(images) == FRAMES
    images[2].write_bytes(images[2].read_bytes()[:200])
    status, out, err = bidnerf("track", "MAP", broken, "--out", tmp_path / "path.txt")
    assert status == 1
    assert err.endswith(f"bidnerf track: 1 of {FRAMES} frames could not be read, see above\n")
    assert str(images[2]) in err
    assert "; left out" in err
    assert re.search(r"not read +1 frame\b", out)
    times = read_trajectory(tmp_path / "path.txt").times.tolist()
    assert times == pytest.approx([n / 30 for n in (0, 1, 3, 4, 5)], abs=1e-6)
    status, _, err = bidnerf("track", "MAP", broken, "--out", tmp_path / "path.txt", "--every", "2", "--overwrite")
    assert status == 1, err
    assert read_trajectory(tmp_path / "path.txt").times.tolist() == pytest.approx([0, 4 / 30], abs=1e-6)


@pytest.mark.slow
def test_frames_of_another_scene_are_doubted(bidnerf: Run, tmp_path: Path) -> None:
    random = np.random.default_rng(0)
    (tmp_path / "images").mkdir()
    for number in range(3):
        noise = random.integers(0, 256, (GROUND_CAMERA.height, GROUND_CAMERA.width, 3), dtype=np.uint8)
        iio.imwrite(tmp_path / "images" / f"{number}.png", noise)
    track = ("track", "MAP", tmp_path / "images", "--out", tmp_path / "path.json", "--hfov", "60")
    err = bidnerf(*track).succeed().err
    assert "no pose of 3 frames was accepted" in err.splitlines()[-1]
    assert len(json.loads((tmp_path / "path.json").read_text())) == 3


def test_one_split_of_a_dataset_is_tracked(bidnerf: Run, tmp_path: Path) -> None:
    named = [View(replace(f, depth=None), T) for _, f, T in flight()[:3]]
    write_transforms(tmp_path / "data", {"train": named[:1], "test": named[1:]}, (0.0, 0.0, 0.0))
    track = ("track", "MAP", tmp_path / "data", "--out", tmp_path / "path.json", "--overwrite", "--split")
    bidnerf(*track, "test").succeed()
    assert len(json.loads((tmp_path / "path.json").read_text())) == 2
    bidnerf(*track, "test", "--first", 1).succeed()
    assert [row["frame"] for row in json.loads((tmp_path / "path.json").read_text())] == [named[1].frame.name]
    assert_refused(bidnerf(*track, "val"), 1, tmp_path / "data", "'val'", "train, test", after_remarks=True)


def test_a_sequence_is_given_up_if_the_first_frames_cannot_be_read(bidnerf: Run, data: Path, tmp_path: Path) -> None:
    broken = Path(shutil.copytree(data, tmp_path / "data"))
    for image in broken.rglob("*.png"):
        image.write_bytes(b"")
    found = bidnerf("track", "MAP", broken, "--out", tmp_path / "none.txt")
    assert_refused(found, 1, "first 3 frames", broken, after_remarks=True)
    assert found.err.count("left out") == 2
    assert not (tmp_path / "none.txt").exists()


def test_json_holds_all_frames(bidnerf: Run, data: Path, tmp_path: Path) -> None:
    assert bidnerf("track", "MAP", data, "--out", tmp_path / "path.json", "--no-depth").status == 0
    found = json.loads((tmp_path / "path.json").read_text())
    assert [row["converged"] for row in found] == [True, True, True, False, True, True]
    assert {"frame", "time", "T_world_camera", "covariance", "outcome", "reason", "error"} <= found[3].keys()
    assert found[0]["method"] == "track"


def test_a_dataset_of_poses_can_be_read_again(bidnerf: Run, data: Path) -> None:
    out = data / "found_transforms.json"
    assert bidnerf("track", "MAP", data, "--out", out, "--every", 2).status == 0
    assert len(json.loads(out.read_text())["frames"]) == 3
    out.unlink()
    assert len(open_dataset(data).frame_names("test")) == FRAMES
