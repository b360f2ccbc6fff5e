"""Files of poses: what is written is what the readers and scipy make of it."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import drawn
from bidnerf.results import PosedImage, read_poses, write_poses

# Inside: writers of single formats, with poses and names that a path does not have
from bidnerf.results.pose_files import write_pose_transforms
from bidnerf_core.camera import Intrinsics
from bidnerf_core.datasets import open_dataset, open_sequence, read_frames, read_posed_images, read_trajectory
from bidnerf_core.errors import InputWarning
from bidnerf_core.frames import Frame
from bidnerf_core.geometry import SE3
from bidnerf_core.io import read_record
from optional import require
from photo_files import noise, write_photo
from refusals import refused

CAMERA = Intrinsics(20.0, 21.0, 7.0, 5.5, 16, 12, (0.01, -0.02, 0.003, 0.004))


def poses(count: int) -> list[SE3]:
    generator = torch.Generator().manual_seed(3)
    tangents = torch.randn((count, 6), generator=generator, dtype=torch.float64)
    half_turn = SE3.exp(torch.tensor([1.0, 2.0, 3.0, torch.pi, 0.0, 0.0], dtype=torch.float64))
    return [SE3.identity().to("cpu", torch.float64), half_turn, *(SE3.exp(tangent) for tangent in tangents)]


def images(names: list[str]) -> list[PosedImage]:
    return [
        PosedImage(name, number, CAMERA, pose)
        for number, (name, pose) in enumerate(zip(names, poses(len(names) - 2), strict=True))
    ]


@pytest.mark.parametrize(
    ("names", "times", "stamps"),
    [
        (["1305031102.211214", "1305031102.175304"], [None, None], [1305031102.175304, 1305031102.211214]),
        (["b", "a"], [7.5, 0.25], [0.25, 7.5]),
        (["7.5", "x"], [None, None], [0, 1]),
        (["0002", "0001"], [None, None], [0, 1]),
        (["1.5", "1.5"], [None, None], [0, 1]),
        (["a", "b"], [1.5, 1.5], [0, 1]),
        (["a", "b"], [1e9, None], [0, 1]),
    ],
)
def test_time_stamps_are_times_where_all_images_have_one(
    names: list[str], times: list[float | None], stamps: list[float], tmp_path: Path
) -> None:
    """evo and the tools of TUM RGB-D refuse stamps that do not increase. A comment names images without a time."""
    given = [replace(image, time=time) for image, time in zip(images(names), times, strict=True)]
    write_poses(tmp_path / "path.tum", given)
    write_poses(tmp_path / "path.euroc.csv", given)
    written, nanoseconds = np.loadtxt(tmp_path / "path.tum"), np.loadtxt(tmp_path / "path.euroc.csv", delimiter=",")
    assert written[:, 0].tolist() == stamps
    assert (nanoseconds[:, 0] * 1e-9).tolist() == pytest.approx(stamps, abs=1e-6)
    order = (0, 1) if stamps == [0, 1] else (1, 0)
    for row, n in zip(written, order, strict=True):
        np.testing.assert_allclose(row[1:4], given[n].T_world_camera.translation, atol=1e-10)
    comments = [line for line in (tmp_path / "path.tum").read_text().splitlines()[1:] if line.startswith("#")]
    assert comments == ([f"# {name}" for name in names] if stamps == [0, 1] else [])


@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_the_reader_finds_the_poses_and_cameras_again(orientation: int, tmp_path: Path) -> None:
    """Photos are read upright, but ``transforms.json`` describes their files as stored: both see each point alike."""
    stored = noise(12, 16)
    file = write_photo(tmp_path / "photos" / "one.png", stored, orientation)
    upright = Frame.open(file, camera=CAMERA)
    T_world_camera = poses(1)[2]
    (tmp_path / "out").mkdir()
    write_pose_transforms(
        tmp_path / "out" / "transforms.json",
        [PosedImage("one", 0, upright.intrinsics, T_world_camera, file)],
    )
    (view,) = open_dataset(tmp_path / "out").views("test")
    assert torch.equal(view.frame.rgb, torch.from_numpy(stored) / 255)
    point = T_world_camera.apply(torch.tensor([0.2, -0.1, 1.5], dtype=torch.float64))
    here, there = (
        frame.intrinsics.project(pose.inverse().apply(point)).floor().long().tolist()
        for frame, pose in ((upright, T_world_camera), (view.frame, view.T_ref_camera))
    )
    assert torch.equal(upright.rgb[here[1], here[0]], view.frame.rgb[there[1], there[0]])
    assert view.frame.intrinsics.distortion == pytest.approx(CAMERA.distortion)


def test_a_mirror_image_has_no_pose(tmp_path: Path) -> None:
    file = write_photo(tmp_path / "one.png", noise(12, 16), 2)
    mirrored = PosedImage("one", 0, CAMERA, SE3.identity(), file)
    with refused(where=file, found="is stored mirrored"):
        write_pose_transforms(tmp_path / "transforms.json", [mirrored])
    assert not (tmp_path / "transforms.json").exists()


def trajectory(path: Path, times: list[float]) -> list[SE3]:
    with warnings.catch_warnings():  # rows without times, in KITTI's format
        warnings.simplefilter("ignore", InputWarning)
        found = read_trajectory(path, times)
    assert found.times.tolist() == pytest.approx(times, abs=1e-6)
    return list(map(SE3, found.rotations, found.translations))


POSE_READERS: dict[str, Callable[[Path, list[float]], list[SE3]]] = {
    "path.tum": trajectory,
    "path.txt": trajectory,
    "path.kitti.txt": trajectory,
    "path.euroc.csv": trajectory,
    "poses.json": lambda path, _: list(read_poses(path).values()),
    "transforms.json": lambda path, _: [frame.T_world_camera for frame in read_frames(read_record(path))],
    "images.txt": lambda path, _: [image.T_camera_model.inverse() for image in read_posed_images(path.parent)[0]],
}


@pytest.mark.parametrize("name", POSE_READERS)
@settings(max_examples=20)
@given(given_poses=st.lists(drawn.poses(), min_size=1, max_size=4), camera=drawn.cameras((0, 4, 5)))
def test_any_poses_that_are_written_are_read_again(
    name: str, given_poses: list[SE3], camera: Intrinsics, tmp_path: Path
) -> None:
    times = [104137.25 + number / 30 for number in range(len(given_poses))]
    write_poses(
        tmp_path / name,
        [PosedImage(f"f{n}", n, camera, T, time=times[n]) for n, T in enumerate(given_poses)],
    )
    found = POSE_READERS[name](tmp_path / name, times)
    assert len(found) == len(given_poses)
    for one, other in zip(found, given_poses, strict=True):
        torch.testing.assert_close(one.matrix(), other.matrix(), atol=1e-9, rtol=0)


def test_frames_of_a_sequence_without_times_get_the_assumed_ones(tmp_path: Path) -> None:
    """A film of a second would otherwise last for minutes; comments name the frames."""
    given = [replace(image, interval=0.05) for image in images(["0004", "0012", "0020"])]
    write_poses(tmp_path / "path.tum", [replace(image, number=4 * image.number) for image in given])
    assert np.loadtxt(tmp_path / "path.tum")[:, 0].tolist() == pytest.approx([0.0, 0.2, 0.4])
    assert (tmp_path / "path.tum").read_text().splitlines()[1::2] == ["# 0004", "# 0012", "# 0020"]


def test_cameras_share_an_entry_only_if_their_pixels_agree(tmp_path: Path) -> None:
    """Localization estimates the camera of each photo anew, so that those of one phone differ by hundredths of a pixel."""
    first, second, third = images(["a", "b", "c"])
    close, far = (replace(CAMERA, fx=CAMERA.fx * factor) for factor in (1.0001, 1.2))
    write_poses(tmp_path / "images.txt", [first, replace(second, intrinsics=close), replace(third, intrinsics=far)])
    assert len((tmp_path / "cameras.txt").read_text().splitlines()) == 2 + 2


def test_names_in_the_poses_of_hloc_have_no_space(tmp_path: Path) -> None:
    with refused(where=tmp_path / "a.hloc.txt", found="the image 'a b' has a space", expected="images.txt or .json"):
        write_poses(tmp_path / "a.hloc.txt", images(["a b", "c"]))


def test_rows_of_kitti_do_not_state_their_image(tmp_path: Path) -> None:
    first, _, *others = images(["a", "b", "c"])
    with pytest.warns(InputWarning, match="image 1 has no pose; KITTI rows do not state their image"):
        write_poses(tmp_path / "path.kitti.txt", [first, *others])


def timed_images(count: int) -> list[PosedImage]:
    generator = torch.Generator().manual_seed(5)
    roots = torch.randn((count, 6, 6), generator=generator, dtype=torch.float64)
    return [
        replace(image, time=104137.25 + number / 30, covariance=1e-4 * root @ root.mT)
        for number, (image, root) in enumerate(zip(images([f"f{n}" for n in range(count)]), roots, strict=True))
    ]


def test_json_has_times_and_covariances(tmp_path: Path) -> None:
    written = [*timed_images(4), replace(timed_images(2)[0], time=None, covariance=None)]
    write_poses(tmp_path / "poses.json", written)
    found = json.loads((tmp_path / "poses.json").read_text())
    assert [entry["frame"] for entry in found] == [image.name for image in written]
    for entry, image in zip(found, written, strict=True):
        assert entry["time"] == image.time
        np.testing.assert_allclose(entry["T_world_camera"], image.T_world_camera.matrix(), atol=0)
        if image.covariance is not None:
            np.testing.assert_allclose(entry["covariance"], image.covariance, atol=0)
    assert found[-1]["covariance"] is None


def test_transforms_with_times_are_a_sequence(tmp_path: Path) -> None:
    written = timed_images(5)[::-1]
    for image in written:
        write_photo(tmp_path / f"{image.name}.png", noise(12, 16), 1)
    write_poses(tmp_path / "transforms.json", [replace(i, file=tmp_path / f"{i.name}.png") for i in written])
    sequence = open_sequence(tmp_path)
    assert [timed.time for timed in sequence] == [image.time for image in written[::-1]]
    for timed, image in zip(sequence, written[::-1], strict=True):
        torch.testing.assert_close(require(timed.truth).matrix(), image.T_world_camera.matrix(), atol=1e-9, rtol=0)


def test_heads_state_the_direction_of_the_poses_and_no_unit_where_there_is_no_pose(tmp_path: Path) -> None:
    write_poses(tmp_path / "none.tum", [])
    assert (tmp_path / "none.tum").read_text().startswith("# timestamp tx ty tz qx qy qz qw (camera to world")
    assert "lengths" not in (tmp_path / "none.tum").read_text()
    image = PosedImage("a", 0, CAMERA, SE3.identity(), unit="metres")
    write_poses(tmp_path / "images.txt", [image])
    head = (tmp_path / "images.txt").read_text()
    assert "world to camera" in head
    assert "lengths in metres" in head
    assert "camera to world" not in head


@pytest.mark.parametrize(("unit", "written"), [("metres", "[m]"), ("units", "[units]")])
def test_the_head_of_euroc_poses_names_the_unit_of_the_map(unit: Any, written: str, tmp_path: Path) -> None:
    metric, asked = (
        PosedImage(name, 0, CAMERA, SE3.identity(), unit=of) for name, of in (("a", "metres"), ("b", unit))
    )
    write_poses(tmp_path / "path.euroc.csv", [metric, asked])
    head = (tmp_path / "path.euroc.csv").read_text().splitlines()[0]
    assert head.split(",")[1:4] == [f"p_RS_R_{axis} {written}" for axis in "xyz"]


def test_an_unknown_ending_is_refused(tmp_path: Path) -> None:
    endings = ".euroc.csv, .hloc.txt, .json, .kitti.txt, .tum, .txt, images.txt, transforms.json"
    with refused(where=tmp_path / "poses.csv", expected=f"a name that ends with {endings}"):
        write_poses(tmp_path / "poses.csv", images(["a", "b"]))


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("given", "kind"),
    [([SE3.identity()], "SE3"), (SE3.identity(), "SE3"), (images(["a", "b"])[0], "PosedImage")],
)
def test_what_is_no_list_of_posed_images_is_refused(given: Any, kind: str, tmp_path: Path) -> None:
    file = tmp_path / "poses.txt"
    with refused(where=file, found=f"got a {kind}", expected="a list of PosedImage(name, number,"):
        write_poses(file, given)
    assert not list(tmp_path.iterdir())
