"""Scans and data sets that are incomplete or state less than usual: what is read of them, and the remarks that say so."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import imageio.v3 as iio
import lzfse
import numpy as np
import pytest
import torch

from bidnerf.testing import training_views
from bidnerf_core.datasets import (
    Capture,
    DatasetOptions,
    Reader,
    Shot,
    Video,
    hold_out,
    open_dataset,
    open_sequence,
)
from bidnerf_core.errors import InputWarning
from bidnerf_core.frames import View
from bidnerf_core.geometry import SE3
from optional import require
from refusals import refused
from scan_layouts import (
    LAYOUTS,
    edit_keys,
    metres,
    packed,
    read_all,
    record3d_files,
    remarks_of,
    small_views,
    write_polycam,
    write_stray_scanner,
    write_twelve_scenes,
    write_video,
)
from tum_folder import edit_rows

pytestmark = pytest.mark.filterwarnings("ignore::bidnerf_core.errors.InputWarning")


@pytest.fixture(scope="module")
def views() -> list[View]:
    return list(training_views())[:4]


def unlinked(*names: str) -> Callable[[Path], object]:
    return lambda root: [next(root.rglob(name)).unlink() for name in names]


def lost_pose(root: Path) -> None:
    poses = json.loads((root / "metadata").read_text())["poses"]
    poses[3] = [float("nan")] * 7
    edit_keys(root / "metadata", poses=poses)
    unlinked("rgbd/1.jpg", "rgbd/2.depth")(root)


def copied_in_part(root: Path) -> None:
    """Four of six images are there, three of their depth images, and the last row of the ground truth is cut off."""
    for kind, kept in (("rgb", 4), ("depth", 3)):
        for file in sorted((root / kind).iterdir())[kept:]:
            file.unlink()
    edit_rows(root / "groundtruth.txt", lambda rows: [*rows[:-1], rows[-1][: rows[-1].index(" ") + 6]])


def missing_and_uncalibrated(root: Path) -> None:
    (root / "images/IMG_2.png").unlink()
    file = root / "cameras.xml"
    file.write_text(file.read_text().replace('sensor_id="0" label="IMG_2"', 'sensor_id="1" label="IMG_2"'))


INCOMPLETE: dict[str, tuple[Callable[[Path], object], int, list[int], list[int], list[str]]] = {
    # The layout, perhaps with a note after a semicolon; what happens to six frames; how many a sequence has then, which of them
    # have no pose and no depth; the remarks.
    "transforms": (
        unlinked("images/r_2.png", "depth/r_5.png"),
        5,
        [],
        [4],
        [
            "1 of 6 images is missing and left out, first: images/r_2.png",
            "1 of 5 depth images is missing and left out, first: depth/r_5.png",
        ],
    ),
    "tum; copied in part": (
        copied_in_part,
        4,
        [],
        [3],
        [
            "2 of 6 images are missing and left out, first: rgb/",
            "3 of 6 depth images are missing and left out",
            "the last row is truncated (2 of 8 entries)",
        ],
    ),
    "record3d, unpacked": (
        lost_pose,
        5,
        [2],
        [1],
        [
            "1 of 6 images is missing and left out, first: rgbd/1.jpg",
            "1 of 5 depth images is missing",
            "1 of 5 images have no pose and are left out",
        ],
    ),
    "polycam": (
        unlinked("corrected_cameras/1000250000.json", "depth/1000500000.png", "corrected_images/1000750000.jpg"),
        4,
        [],
        [1],
        [
            "1 of 5 images is missing and left out",
            "1 of 5 photos have no camera in corrected_cameras",
            "1 of 4 depth images is missing",
        ],
    ),
    "polycam, not corrected": (unlinked(), 6, [], [], ["no corrected_cameras, so the poses are ARKit's, which drift"]),
    "tum": (
        lambda root: edit_rows(
            root / "groundtruth.txt",
            lambda r: [r[0].replace(" ", " nan ", 1), f"{r[1].split()[0]} 1 2 3 0 0 0 0", *r[2:]],
        ),
        6,
        [0],
        [],
        [
            "2 poses of 12 not finite or zero, left out",
            "1 of 6 images have no pose",
        ],
    ),
    "seven-scenes": (
        unlinked("frame-000001.pose.txt", "frame-000002.depth.png"),
        6,
        [1],
        [2],
        [
            "1 of 6 images have no pose and are left out",
        ],
    ),
    "twelve-scenes": (
        lambda root: (root / "data/frame-000002.pose.txt").write_text("-inf -inf -inf -inf\n" * 4),
        6,
        [2],
        [],
        ["1 of 6 images have no pose and are left out"],
    ),
    "reality-capture": (
        unlinked("2.png"),
        5,
        [],
        [*range(5)],
        [
            "1 of 6 images is missing and left out, first: 2.png",
        ],
    ),
    "kitti": (unlinked("image_2/000001.png"), 5, [], [*range(5)], ["1 of 6 images are missing, first: number 1"]),
    "euroc": (unlinked("cam0/data/*.png"), 5, [], [*range(5)], ["1 of 6 images is missing and left out"]),
    "metashape": (
        missing_and_uncalibrated,
        5,
        [],
        [*range(5)],
        ["1 of 6 images is missing and left out, first: IMG_2"],
    ),
    "colmap": (
        lambda root: (root / "images/r_2.png").rename(root / "images/r_9.png"),
        5,
        [],
        [*range(5)],
        [
            "1 of 6 images is missing and left out, first: images/r_2.png",
            "1 of 6 photos are not registered in the model and are left out, first: r_9.png",
        ],
    ),
}


@pytest.mark.parametrize("kind", INCOMPLETE)
def test_what_is_missing_is_left_out_and_counted(kind: str, tmp_path: Path) -> None:
    edit, count, without_pose, without_depth, expected = INCOMPLETE[kind]
    layout = LAYOUTS[kind.partition(";")[0]]
    folder, options = layout.write(tmp_path, small_views(6)), layout.options
    edit(tmp_path)
    said = remarks_of(folder, **options)
    assert len(said) == len(expected)
    for remark in expected:
        assert sum(remark in text for text in said) == 1, said
    frames = list(open_sequence(folder, **options))
    assert len(frames) == count
    assert [n for n, timed in enumerate(frames) if timed.truth is None] == without_pose
    assert [n for n, timed in enumerate(frames) if timed.frame.depth is None] == without_depth
    posed = sorted(timed.frame.name for timed in frames if timed.truth is not None)
    assert sorted(read_all(folder, **options)) == posed


# Record3D


def metadata(files: dict[str, bytes], **changes: object) -> dict[str, bytes]:
    return {**files, "metadata": json.dumps({**json.loads(files["metadata"]), **changes}).encode()}


def test_depth_of_low_confidence_far_away_and_not_finite_is_dropped(views: list[View], tmp_path: Path) -> None:
    """Depth has a quarter of the photo's resolution, each number repeated; four of its pixels hold none."""
    size = metres(views[0]).shape
    depth = np.full((size[0] // 4, size[1] // 4), 2.0, np.float32)
    depth[0, :4] = np.nan, 0, 6, -1
    sure = np.full(depth.shape, 2, np.uint8)
    sure[1, :2] = 1, 0
    files = metadata(record3d_files(views), dw=depth.shape[1], dh=depth.shape[0])
    files |= {"rgbd/0.depth": lzfse.compress(depth.tobytes()), "rgbd/0.conf": lzfse.compress(sure.tobytes())}
    found = open_dataset(packed(tmp_path, files)).views("test", ["0"])[0].frame.depth
    expected = depth.copy()
    expected[0, :4], expected[1, :2] = 0, 0
    np.testing.assert_array_equal(found, expected.repeat(4, 0).repeat(4, 1))


def test_intrinsics_of_the_first_frame_hold_for_all_where_there_are_no_others(
    views: list[View], tmp_path: Path
) -> None:
    files = metadata(record3d_files(views), perFrameIntrinsicCoeffs=None)
    frames = list(open_sequence(packed(tmp_path, files)))
    for timed in frames:
        torch.testing.assert_close(
            timed.frame.intrinsics.matrix(), views[0].frame.intrinsics.matrix(), atol=1e-9, rtol=0
        )


def test_confidence_that_removes_all_depth_is_said_once_with_its_values(views: list[View], tmp_path: Path) -> None:
    scan = write_polycam(tmp_path / "polycam", views)
    for file in (scan / "keyframes" / "confidence").iterdir():
        iio.imwrite(file, np.full(metres(views[0]).shape, 254, np.uint8))
    said = [text for text in remarks_of(scan) if "confidence" in text]
    assert len(said) == 1
    assert "has the values 254, expected 255 where depth is sure" in said[0]
    files = record3d_files(views)
    low = np.zeros(metres(views[0]).shape, np.uint8)
    low[0] = 1
    assert remarks_of(packed(tmp_path, files)) == []
    (said_of_one,) = remarks_of(packed(tmp_path, files | {"rgbd/1.conf": lzfse.compress(low.tobytes())}))
    assert "rgbd/1.conf: has the values 0, 1, expected 2 where depth is sure" in said_of_one


# Polycam


def test_undistorted_photos_hide_their_border(views: list[View], tmp_path: Path) -> None:
    for corrected in (True, False):
        folder = write_polycam(tmp_path / str(corrected), views, corrected)
        hidden = next(iter(open_sequence(folder))).frame.hidden
        assert (hidden is not None) == corrected
        if hidden is not None:
            assert not bool(hidden[15:-15, 15:-15].any())
            assert int((~hidden).sum()) == (hidden.shape[0] - 30) * (hidden.shape[1] - 30)


def test_cameras_without_a_size(views: list[View], tmp_path: Path) -> None:
    folder = write_polycam(tmp_path, views)
    for file in (folder / "keyframes/corrected_cameras").iterdir():
        content = json.loads(file.read_text())
        del content["width"], content["height"]
        file.write_text(json.dumps(content))
    assert open_dataset(folder).views("test")[0].frame.intrinsics == views[0].frame.intrinsics


# Stray Scanner


def test_a_video_of_another_length_and_missing_depth(views: list[View], tmp_path: Path) -> None:
    folder = write_stray_scanner(tmp_path, views)
    write_video(folder / "rgb.mp4", [np.full((96, 128, 3), 50, np.uint8)] * 3)
    (folder / "depth/000001.png").unlink()
    said = remarks_of(folder)
    assert any("1 of 4 images is missing and left out, first: rgb.mp4/000003" in text for text in said)
    assert [timed.frame.depth is not None for timed in open_sequence(folder)] == [True, False, True]
    with (folder / "odometry.csv").open("a") as file:
        file.write("1000.7")
    assert any("the last row is truncated (1 of 9 entries)" in text for text in remarks_of(folder))


def test_intrinsics_of_each_frame(views: list[View], tmp_path: Path) -> None:
    folder = write_stray_scanner(tmp_path, views)
    rows = (folder / "odometry.csv").read_text().splitlines()
    rows = [
        f"{rows[0]}, fx, fy, cx, cy",
        *(f"{row}, {100 + n}, 101, 63.5, 47.5" for n, row in enumerate(rows[1:])),
    ]
    (folder / "odometry.csv").write_text("\n".join(rows))
    found = [timed.frame.intrinsics for timed in open_sequence(folder)]
    assert [(camera.fx, camera.fy, camera.cx, camera.cy) for camera in found] == [
        (100 + n, 101, 64, 48) for n in range(4)
    ]


def test_frames_of_a_video_in_any_order(tmp_path: Path) -> None:
    """Each frame is of one grey, which tells its number."""
    write_video(tmp_path / "v.mp4", [np.full((32, 48, 3), 8 * number, np.uint8) for number in range(30)])
    video = Video(tmp_path / "v.mp4")
    assert len(video) == 30
    assert video.size == (48, 32)
    for number in (0, 1, 2, 9, 8, 29, 13, 14, 0):
        assert float(video.pixels(number).mean()) == pytest.approx(8 * number, abs=2)
    with refused(where=tmp_path / "v.mp4", found="has 30 frames, but frame 30"):
        video.pixels(30)
    content = (tmp_path / "v.mp4").read_bytes()
    (tmp_path / "v.mp4").write_bytes(content[: len(content) // 2])
    with refused(where=tmp_path / "v.mp4", expected="a video file"):
        Video(tmp_path / "v.mp4").pixels(0)


def test_five_frames_a_second_are_kept() -> None:
    for rate, kept in ((60, 12), (30, 6), (10, 2), (5, 1), (2, 1)):
        frames = [Shot(image=Path(f"{n}.png"), T_world_camera=SE3.identity(), time=10 + n / rate) for n in range(120)]
        found = hold_out(frames, rate=5.0)
        assert [int(shot.stem) for shot in found if shot.splits] == list(range(0, 120, kept))
        assert len(found) == 120


def test_frames_that_a_dataset_leaves_out_are_counted(tmp_path: Path) -> None:
    class Fast(Reader):
        expected = "frames"

        def recognises(self, path: Path) -> bool:
            return True

        def read(self, path: Path, options: DatasetOptions) -> Capture:
            shots = [Shot(stem=f"{n}", T_world_camera=SE3.identity(), time=n / 30) for n in range(60)]
            return Capture(path, shots, rate=5.0)

    with pytest.warns(InputWarning, match="has 10 of 60 frames, 5 per second; the sequence has all"):
        dataset = open_dataset(tmp_path, readers=[Fast()])
    assert len(dataset.frame_names("all")) == 10
    assert len(dataset) == 60


# Data sets


def test_depth_of_another_camera_is_registered(views: list[View], tmp_path: Path) -> None:
    """The depth camera sees twice as much: what it sees in the middle is what the photo shows."""
    folder = write_twelve_scenes(tmp_path, views)
    info = (folder / "info.txt").read_text()
    line = next(line for line in info.splitlines() if line.startswith("m_calibrationDepthIntrinsic"))
    (folder / "info.txt").write_text(info.replace(line, line.replace("130.0", "65.0")))
    iio.imwrite(folder / "data/frame-000000.depth.png", np.full((96, 128), 1500, np.uint16))
    depth = require(open_dataset(folder).views("test", ["frame-000000"])[0].frame.depth)
    assert depth.unique().tolist() == pytest.approx([1.5])


def test_the_frames_of_twelve_scenes_are_a_sequence_without_their_parent(tmp_path: Path) -> None:
    folder = write_twelve_scenes(tmp_path, small_views(4))
    assert len(open_sequence(folder / "data")) == 4
    text = (
        (folder / "info.txt").read_text().replace("m_calibrationColorIntrinsic = ", "m_calibrationColorIntrinsic = 9")
    )
    (folder / "data/info.txt").write_text(text)
    here, above = (open_dataset(each).views("test")[0].frame.intrinsics.fx for each in (folder / "data", folder))
    assert str(here) == f"9{above}"
    (folder / "data/info.txt").unlink()
    assert open_dataset(folder).frame_names("test") == ["frame-000000", "frame-000001"]
