"""Folders of the TUM RGB-D benchmark: published cameras, lists that are read together, and their trajectories."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation, Slerp

from bidnerf_core.camera import Intrinsics
from bidnerf_core.datasets import open_dataset, open_sequence, read_trajectory
from bidnerf_core.datasets.formats.tum import SENSORS, associate

# Inside: the published cameras and the association of times, compared with OpenCV and SciPy
from bidnerf_core.geometry import SE3
from optional import require
from refusals import refused
from scan_layouts import remarks_of, small_views, write_tum
from tum_folder import edit_rows

pytestmark = pytest.mark.filterwarnings("ignore::bidnerf_core.errors.InputWarning")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Ten frames at 30 Hz, whose folder's name says nothing about the sensor, with the camera in a file."""
    return write_tum(tmp_path / "recording", small_views(10), 1305031102.175304, 0.033)


@pytest.mark.parametrize("sensor", ["1", "2", "3"])
def test_published_lenses_can_be_inverted_everywhere(sensor: str) -> None:
    camera = SENSORS[sensor]
    pixels = camera.pixel_centres(torch.float64)[::20, ::20]
    torch.testing.assert_close(camera.project(camera.unproject(pixels)), pixels, atol=1e-6, rtol=0)


def test_the_published_lens_projects_as_opencv_does() -> None:
    """OpenCV counts from the centre of the upper left pixel, as the benchmark's numbers do."""
    published = np.array([[517.3, 0, 318.6], [0, 516.5, 255.3], [0, 0, 1]])
    lens = np.array([0.2624, -0.9531, -0.0054, 0.0026, 1.1633])
    points = np.random.default_rng(0).uniform([-0.6, -0.45, 1], [0.6, 0.45, 1], (50, 3))
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), published, lens)
    found = SENSORS["1"].project(torch.from_numpy(points))
    np.testing.assert_allclose(found - 0.5, expected[:, 0], atol=1e-9)


def test_a_camera_that_is_given_goes_first(folder: Path, tmp_path: Path) -> None:
    other = Intrinsics(30.0, 30.0, 8.0, 6.0, 16, 12)
    assert next(iter(open_sequence(folder, camera=other))).frame.intrinsics == other
    assert open_dataset(folder, camera=other).views("test")[0].frame.intrinsics == other
    file = tmp_path / "cameras.txt"
    file.write_text("1 PINHOLE 16 12 30 30 8 6\n")
    assert open_dataset(folder, camera=file).views("test")[0].frame.intrinsics == other


@pytest.mark.parametrize(
    ("name", "sensor"),
    [("rgbd_dataset_freiburg1_xyz", "1"), ("freiburg1", "1"), ("fr2", "2"), ("Freiburg3", "3")],
)
def test_the_name_of_a_sensor_says_the_camera(name: str, sensor: str, folder: Path) -> None:
    """The folder's own name does, and the name that is given; a camera in the folder goes before the folder's name."""
    expected = SENSORS[sensor].resized(16, 12)
    if "_" not in name:
        assert next(iter(open_sequence(folder, camera=name))).frame.intrinsics == expected
        assert open_dataset(folder, camera=Path(name)).views("test")[0].frame.intrinsics == expected
    (folder / "camera.json").unlink()
    renamed = folder.rename(folder.with_name(name))
    assert next(iter(open_sequence(renamed))).frame.intrinsics == expected


def first_depth(offset: float, name: str = "", rest: int = 1) -> Callable[[list[str]], list[str]]:
    """Return an edit that moves the first depth image in time or, with a name, adds another one before it."""

    def edit(rows: list[str]) -> list[str]:
        time, own = rows[0].split()
        return [f"{float(time) + offset:.6f} {name or own}", *rows[rest:]]

    return edit


@pytest.mark.parametrize(
    ("file", "change", "without_truth", "without_depth"),
    [
        ("groundtruth.txt", lambda rows: rows[2:10] + rows[18:], [0, 5, 6, 7, 8], []),  # a gap of 0.16 s
        ("groundtruth.txt", None, range(10), []),
        ("groundtruth.txt", lambda rows: [], range(10), []),  # a header alone
        ("depth.txt", first_depth(0.0165), [], [0]),  # too late for its image
        ("depth.txt", None, [], range(10)),
        ("depth.txt", first_depth(-0.001, "depth/gone.png", 0), [], []),  # the next one takes its place
    ],
)
def test_images_have_the_truth_and_the_depth_of_their_times(
    file: str, change: Callable[[list[str]], list[str]] | None, without_truth: Any, without_depth: Any, folder: Path
) -> None:
    (folder / file).unlink() if change is None else edit_rows(folder / file, change)
    frames = list(open_sequence(folder))
    assert [place for place, timed in enumerate(frames) if timed.truth is None] == list(without_truth)
    assert [place for place, timed in enumerate(frames) if timed.frame.depth is None] == list(without_depth)
    assert all((timed.split is None) == (timed.truth is None) for timed in frames)


def test_lists_may_be_in_any_order_and_end_as_on_windows(folder: Path) -> None:
    expected = [(timed.time, timed.frame.name, timed.truth) for timed in open_sequence(folder)]
    for name in ("rgb.txt", "depth.txt", "groundtruth.txt"):
        edit_rows(folder / name, lambda rows: rows[::-1])
        content = (folder / name).read_bytes()
        (folder / name).write_bytes(b"\xef\xbb\xbf" + content.replace(b"\n", b"\r\n") + b"\r\n\r\n")
    for timed, (time, name, truth) in zip(open_sequence(folder), expected, strict=True):
        assert (timed.time, timed.frame.name) == (time, name)
        torch.testing.assert_close(require(timed.truth).matrix(), require(truth).matrix())


def test_names_with_blanks_and_windows_separators(folder: Path) -> None:
    expected = [timed.frame.rgb for timed in open_sequence(folder)]
    (folder / "rgb").rename(folder / "my rgb")
    (folder / "depth").rename(folder / "my depth")
    for name, kind in (("rgb.txt", "rgb"), ("depth.txt", "depth")):
        edit_rows(folder / name, lambda rows, kind=kind: [row.replace(f" {kind}/", f" my {kind}\\") for row in rows])
    assert not remarks_of(folder)
    for timed, rgb in zip(open_sequence(folder), expected, strict=True):
        assert torch.equal(timed.frame.rgb, rgb)
        assert timed.frame.depth is not None


def numbers(values: Any) -> str:
    return " ".join(repr(float(value)) for value in values)


def w_first(T: SE3) -> list[float]:
    """Translation and quaternion, as EuRoC orders them."""
    return [*T.translation, *Rotation.from_matrix(T.rotation.numpy()).as_quat(scalar_first=True)]


TRAJECTORIES: dict[str, tuple[str, Callable[[float, SE3], str]]] = {
    "header with wxyz": (
        "# timestamp tx ty tz qw qx qy qz",
        lambda time, T: f"{time:.6f} {numbers(w_first(T))}",
    ),
    "EuRoC": (
        "#timestamp, p_RS_R_x [m], p_RS_R_y [m]",
        lambda time, T: ",".join([str(round(time * 1e6) * 1000), *numbers(w_first(T)).split(), *"000000000"]),
    ),
    "KITTI": ("", lambda time, T: numbers(T.matrix()[:3].flatten())),
}


@pytest.mark.parametrize(
    ("name", "content", "seconds"),
    [
        ("path.txt", "1403636579763555584.0 0 0 0 0 0 0 1\n", 1403636579.7635556),
        # Of any size where the header states the unit: a device that has been up for ten days.
        ("path.csv", "#timestamp [ns]\n863636579763555,0,0,0,1,0,0,0\n", 863636.579763555),
    ],
)
def test_nanoseconds_may_have_a_fraction_and_are_stated_by_a_header(
    name: str, content: str, seconds: float, tmp_path: Path
) -> None:
    (tmp_path / name).write_text(content)
    found = read_trajectory(tmp_path / name)
    assert found.times.tolist() == pytest.approx([seconds])
    assert torch.equal(found.rotations[0], torch.eye(3, dtype=torch.float64))


@pytest.mark.parametrize("kind", TRAJECTORIES)
def test_trajectories_of_other_kinds(kind: str, folder: Path) -> None:
    frames = [(timed.time, timed.truth) for timed in open_sequence(folder)]
    header, row = TRAJECTORIES[kind]
    rows = [row(time, truth) for time, truth in frames if time is not None and truth is not None]
    (folder / "groundtruth.txt").write_text("\n".join([header, *rows]) + "\n")
    said = remarks_of(folder)
    assert len(said) == (kind == "KITTI")
    for timed, (_, truth) in zip(open_sequence(folder), frames, strict=True):
        torch.testing.assert_close(require(timed.truth).matrix(), require(truth).matrix(), atol=1e-9, rtol=0)
    edit_rows(folder / "groundtruth.txt", lambda rows: rows[:-1])
    if kind == "KITTI":
        with refused(
            where=folder / "groundtruth.txt",
            found="which have no times; there are 9 for 10 images",
            expected="one for each image",
        ):
            open_dataset(folder)


def test_pairs_are_each_others_nearest() -> None:
    generator = np.random.default_rng(1)
    times, others = np.sort(generator.uniform(0, 10, 80)), np.sort(generator.uniform(0, 10, 110))
    distance = np.abs(times[:, None] - others)
    expected = {
        int(i): int(distance[i].argmin())
        for i in range(80)
        if distance[i].min() <= 0.02 and distance[:, distance[i].argmin()].argmin() == i
    }
    assert associate(times.tolist(), others.tolist(), 0.02) == expected
    assert associate([1.0], [1.01], 0.02) == {0: 0}
    assert associate([], [1.0], 0.02) == {}
    assert associate([1.0], [], 0.02) == {}


def test_interpolation_is_scipys_slerp(tmp_path: Path) -> None:
    generator = np.random.default_rng(2)
    times = np.sort(generator.uniform(0, 0.5, 20))
    turns, places = Rotation.random(20, rng=generator), generator.normal(size=(20, 3))
    rows = np.column_stack([times, places, turns.as_quat()])
    np.savetxt(tmp_path / "path.txt", rows, fmt="%.17g")
    path = read_trajectory(tmp_path / "path.txt")
    slerp = Slerp(times, turns)
    for time in generator.uniform(times[0], times[-1], 30):
        found = require(path.at(time, largest_gap=1.0))
        np.testing.assert_allclose(found.rotation, slerp(time).as_matrix(), atol=1e-9)
        np.testing.assert_allclose(found.translation, [np.interp(time, times, p) for p in places.T], atol=1e-9)
    for time in times:
        assert path.at(float(time)) is not None
    assert path.at(times[0] - 1e-3) is None
    assert path.at(times[-1] + 1e-3) is None
