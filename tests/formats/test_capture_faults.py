"""What is said of datasets that are broken: one line with the file and its fault, whatever the layout."""

from __future__ import annotations

import copy
import math
import os
import shutil
import sys
import zipfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import lzfse
import numpy as np
import pytest
from PIL import Image

# Inside: the limit of a member, which a small archive exceeds
from bidnerf_core.datasets import open_dataset, open_sequence
from bidnerf_core.errors import InputWarning
from refusals import refused
from scan_layouts import (
    LAYOUTS,
    SMALL,
    edit_frame,
    edit_keys,
    every_frame,
    message,
    opengl,
    packed,
    read_all,
    record3d_files,
    small_views,
)
from tum_folder import edit_rows

COUNT = 6
Edit = Callable[[Path], object]


def rows(change: Callable[[list[str]], list[str]]) -> Edit:
    return lambda file: edit_rows(file, change)


def first_row(*words: str) -> Edit:
    """Replace the first entries of the first row."""
    return rows(lambda given: [" ".join([*words, *given[0].split()[len(words) :]]), *given[1:]])


def replaced(old: str, new: str) -> Edit:
    def edit(file: Path) -> None:
        text = file.read_text()
        assert old in text
        file.write_text(text.replace(old, new, 1))

    return edit


def content(new: bytes | str) -> Edit:
    return lambda file: file.write_bytes(new if isinstance(new, bytes) else new.encode())


def keys(**changes: Any) -> Edit:
    return partial(edit_keys, **changes)


def frame(number: int = 1, **changes: Any) -> Edit:
    return partial(edit_frame, number=number, **changes)


POSE = opengl(small_views(2)[1]).tolist()


def pose_with(value: Any, row: int = 1, column: int = 3) -> Edit:
    matrix: list[list[Any]] = copy.deepcopy(POSE)
    matrix[row][column] = value
    return frame(transform_matrix=matrix)


def image(shape: tuple[int, ...], kind: type = np.uint16, cut: bool = False) -> Edit:
    def edit(file: Path) -> None:
        iio.imwrite(file, np.ones(shape, kind))
        if cut:
            file.write_bytes(file.read_bytes()[:-40])

    return edit


def depth_array(file: Path) -> None:
    (file.parent / "depth/r_0.npy").write_bytes(b"no array")
    frame(0, depth_file_path="depth/r_0.npy")(file)


def fisheye(file: Path) -> None:
    replaced("radial-tangential", "equidistant")(file)
    replaced("[0.0, 0.0, 0.0, 0.0]", "[0.1, 0.0, 0.0, 0.0]")(file)


JSON = "transforms.json"
DIGITS = "9" * 5000  # more than Python converts to an integer
DEPTH_OF_TUM = "depth/1000.004000.png"
FAULTS: dict[str, list[tuple[str, Edit, str | tuple[str, ...]]]] = {
    "record3d, unpacked": [
        ("metadata", keys(poses=[]), "no poses"),
        ("metadata", keys(poses=[[0] * 6] * COUNT), ("pose 0", "7 numbers")),
        ("metadata", keys(poses=[[1, 1, 0, 0, 0, 0, 0]] * COUNT), ("pose 0", "quaternion", "1.41")),
        ("metadata", keys(w=None), "no w and h"),
        ("metadata", keys(perFrameIntrinsicCoeffs=[[20.0, 21.0, 8.0, 6.0]] * 7), ("has 7 rows", "6, as poses")),
        ("metadata", keys(K=None, perFrameIntrinsicCoeffs=None), ("no K", "9 numbers")),
        ("metadata", content("{"), "not JSON"),
        ("rgbd/0.depth", lambda file: file.write_bytes(file.read_bytes()[:50]), ""),
        ("rgbd/0.depth", content(lzfse.compress(bytes(10**7))), ""),
        ("rgbd/0.jpg", lambda file: file.write_bytes(file.read_bytes()[:300]), "not readable as an image"),
        ("rgbd/0.jpg", content(b""), "the file is empty"),
    ],
    "tum": [
        ("groundtruth.txt", rows(lambda r: [r[0][:12], *r[1:]]), ("line 4", "2 of 8", "timestamp tx ty tz")),
        ("groundtruth.txt", content(""), "the poses of the frames of a dataset"),
        ("groundtruth.txt", first_row("999.997", *"123000", "0.5"), ("line 4", "quaternion", "0.5")),
        ("groundtruth.txt", first_row("999.997", "a"), ("line 4", "'a'")),
        ("groundtruth.txt", rows(lambda r: [*r, f"{r[0].split()[0]} 0 0 0 0 0 0 1"]), "another pose at the time"),
        (
            "groundtruth.txt",
            rows(lambda r: ["1.0 0 0 0 0 0 0 1", "1.05 0 0 0 0 0 0 1"]),
            "has no pose for any of 6 images",
        ),
        ("groundtruth.txt", Path.unlink, "the poses of the frames of a dataset"),
        ("rgb.txt", rows(lambda r: [r[0].split()[0], *r[1:]]), ("line 4", "1 of 2")),
        ("rgb.txt", content("# nothing\n"), ("no rows", "timestamp filename")),
        ("rgb.txt", first_row("soon"), ("line 4", "'soon'")),
        ("rgb.txt", rows(lambda r: [*r, r[2]]), ("line 10", "1000.5", "line 6")),
        ("rgb.txt", content(b"\xff\xfe\x00\x01"), "is not text"),
        ("rgb.txt", first_row("1305031102175"), ("line 4", "1305031102175 is no time in seconds", "milliseconds")),
        ("rgb.txt", first_row("1305031102175000"), ("line 4", "no time in seconds", "or microseconds")),
        ("depth.txt", first_row("inf"), ("line 4", "inf")),
        ("camera.json", Path.unlink, ("freiburg1", "camera.json or cameras.txt", "`camera`")),
        (DEPTH_OF_TUM, image((6, 6)), ("depth is 6x6", "16x12")),
    ],
    "seven-scenes": [
        ("frame-000000.pose.txt", rows(lambda r: [r[0], r[1][:20]]), ("line 2", "1 entries", "4")),
        ("frame-000000.pose.txt", rows(lambda r: r[:2]), ("2 rows", "4 rows")),
        ("frame-000000.pose.txt", content(""), "0 rows"),
        ("frame-000000.pose.txt", first_row("lost"), ("line 1", "'lost'")),
        ("frame-000000.pose.txt", first_row("3"), ("off orthonormal",)),
        ("frame-000000.pose.txt", rows(lambda r: [*r[:3], "0 0 0 2"]), "last row"),
        ("frame-000000.depth.png", image((8, 8)), ("depth is 8x8", "aspect ratio")),
    ],
    "reality-capture": [
        ("cameras.csv", replaced(",f,", ",focal,"), ("has the columns", "Internal/External")),
        (
            "cameras.csv",
            lambda file: file.write_bytes(file.read_bytes() + b"6.png,0\r7"),
            ("line 8", "comma-separated"),
        ),
    ],
    "kitti": [
        ("../../poses/07.txt", Path.unlink, "poses.txt"),
        *(
            ("calib.txt", content(f"P2: {row}\n"), "projects no image")
            for row in ("0 " * 12, "2 0 6 0 0 2 6 0 2 0 6 0")
        ),
    ],
    "twelve-scenes": [
        ("info.txt", replaced("m_colorWidth = 16", "m_colorWidth = nan"), "its size is nan"),
        ("info.txt", replaced("m_depthHeight = 12", "m_depthHeight = inf"), "its size is"),
        ("split.txt", content(f"sequence0 [start=0 ; end={DIGITS}]"), "not finite"),
    ],
    "euroc": [
        ("mav0/cam0/sensor.yaml", fisheye, ("equidistant", "radial-tangential")),
        ("mav0/cam0/sensor.yaml", replaced("resolution", "size"), ("resolution: has 0 numbers", "expected 2")),
        ("mav0/cam0/sensor.yaml", content("sensor_type: [camera"), "not YAML"),
        ("mav0/cam0/sensor.yaml", content("camera"), "has no entries"),
        ("mav0/cam0/sensor.yaml", replaced("[16, 12]", "[nan, 12]"), ("resolution", "not finite")),
        ("mav0/cam0/sensor.yaml", replaced("[16, 12]", "[.nan, 12]"), ("resolution", "not finite")),
        ("mav0/cam0/sensor.yaml", replaced("[16, 12]", f"[{DIGITS}, 12]"), ("resolution", "not finite")),
        ("mav0/cam0/sensor.yaml", replaced("[16, 12]", "[1e300, 12]"), ("its size is 1e+300 x 12", "whole numbers")),
    ],
    "colmap": [
        ("sparse/0/cameras.txt", replaced("OPENCV", "THIN_PRISM_FISHEYE"), ("line 2", "THIN_PRISM_FISHEYE")),
        ("sparse/0/cameras.txt", replaced("OPENCV", "PINHOLE"), ("line 2", "PINHOLE", "8 parameters", "4")),
        (
            "sparse/0/cameras.txt",
            rows(lambda r: [*r, r[0].replace("20.0", "30.0")]),
            ("line 3", "camera 1 is repeated"),
        ),
        ("sparse/0/cameras.txt", replaced("1 OPENCV", "6 OPENCV"), ("r_0.png", "camera 1", "missing")),
        ("sparse/0/images.txt", replaced("r_1.png", "r_0.png"), ("r_0.png", "registered twice")),
        ("sparse/0/images.txt", content("# nothing\n"), "no registered image"),
    ],
    "transforms": [
        (JSON, content('{"frames": [}'), ("not JSON", "line 1, column 13")),
        (JSON, content('{\n"fl_x": 1,,\n}'), ("not JSON", "line 2, column 11")),
        (JSON, content("[" * 100_000), ("not JSON", "while decoding a JSON array")),
        (JSON, content(b'{"a": "\xff\xfe"}'), "not JSON"),
        (JSON, keys(frames=None), "no frames"),
        (JSON, keys(frames=[]), "frames is empty"),
        (JSON, keys(frames=["a"]), ("frame 0", "object")),
        (JSON, frame(file_path=None), ("frame 1", "no file_path")),
        (JSON, frame(file_path="./images/r_0"), ("frame 1 (./images/r_0)", "same image as frame 0")),
        (JSON, frame(transform_matrix=[[1, 0], [0, 1]]), ("transform_matrix", "3x4 or 4x4")),
        (JSON, frame(transform_matrix=[1.0] * 16), ("transform_matrix", "3x4 or 4x4")),
        (JSON, pose_with(POSE[0][1] + 0.1, 0, 1), ("frame 1 (images/r_1.png)", "off orthonormal", "rigid")),
        (JSON, frame(transform_matrix=[[-r[0], *r[1:]] for r in POSE[:3]]), "mirror image"),
        (JSON, pose_with(0.5, 3, 0), ("[0.5, 0.0, 0.0, 1.0]", "[0, 0, 0, 1]")),
        (JSON, frame(transform_matrix=[*POSE[:3], [0, 0, 0, 0]]), ("last row", "[0, 0, 0, 1]")),
        (JSON, keys(fl_x=None, fl_y=None), ("no focal length", "fl_x", "camera_angle_x")),
        (JSON, keys(fl_x=0), ("frame 0 (images/r_0.png)", "fl_x is 0", "positive")),
        (JSON, keys(fl_x=True), ("fl_x is true", "finite number")),
        (JSON, frame(camera_angle_x=180.0), ("camera_angle_x is 180", "radians")),
        (JSON, keys(w=0), ("w is 0", "positive whole number")),
        (JSON, keys(camera_model="FISHEYE624"), ("camera_model is FISHEYE624", "OPENCV")),
        (JSON, keys(is_fisheye=True, cx=-5), "maps no ray"),
        (JSON, frame(cx=1e308), ("frame 1 (images/r_1.png)", "cx is 1e+308")),
        (JSON, frame(fl_x=1e-308), ("frame 1 (images/r_1.png)", "fx is 1e-308")),
        (JSON, frame(k1=1e308), "real lens"),
        (JSON, keys(k4=0.1), ("k4", "k1 k2 p1 p2 k3")),
        (JSON, keys(depth_unit_scale_factor=0), ("depth_unit_scale_factor is 0", "positive")),
        (JSON, keys(train_filenames=["images/nix.png"]), ("train_filenames", "images/nix.png", "6 frames")),
        (JSON, keys(applied_transform=[[0.0] * 4] * 3), "applied_transform is singular"),
        (JSON, keys(applied_transform=[[math.nan] * 4] * 3), "an entry of applied_transform is NaN"),
        (JSON, frame(0, time="noon"), ("frame 0", "time", "finite number")),
        (JSON, frame(0, time=10**400), ("frame 0", "time", "finite number")),
        (JSON, keys(w=17), ("image is 16x12", "its camera is for 17x12")),
        (
            JSON,
            lambda f: (keys(w=None, h=None)(f), image((13, 16, 3), np.uint8)(f.parent / "images/r_2.png")),
            ("images/r_2.png", "16x13", "16x12"),
        ),
        ("images/r_2.png", image((500, 400, 3), np.uint8, cut=True), ("400x500", "16x12")),  # is not decoded
        (
            "images/r_0.png",
            lambda file: Image.fromarray(np.zeros((12, 16), np.float32)).save(file, "TIFF"),
            ("float32", "RGB"),
        ),
        ("depth/r_0.png", image((12, 16, 3), np.uint8), ("12x16x3", "one channel")),
        ("depth/r_0.png", image((12, 8)), ("depth is 8x12", "16x12")),
        (JSON, depth_array, ("r_0.npy", "not readable as an array")),
    ],
}
NEEDED_BY_DATASETS = (
    "has no pose for any of 6 images",
    "the poses of the frames of a dataset",
    "poses.txt",
)  # sequences do without poses
CASES = {
    f"{kind}: {file}: {said}": (kind, file, edit, said)
    for kind, faults in FAULTS.items()
    for file, edit, said in faults
}


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[Path, Path]]:
    """The root and the folder of a dataset in each layout."""
    roots = {kind: tmp_path_factory.mktemp("sound") for kind in FAULTS}
    return {kind: (root, LAYOUTS[kind].write(root, small_views(COUNT))) for kind, root in roots.items()}


@pytest.mark.parametrize("case", CASES)
def test_a_fault_is_named_in_one_line(case: str, sound: dict[str, tuple[Path, Path]], tmp_path: Path) -> None:
    kind, file, edit, said = CASES[case]
    root, folder = sound[kind]
    copied = shutil.copytree(root, tmp_path / "copy") / folder.relative_to(root)
    edit(copied / file)
    for read in (read_all,) if said in NEEDED_BY_DATASETS else (read_all, every_frame):
        text = message(copied, read, **LAYOUTS[kind].options)
        assert all(part in text for part in ((said,) if isinstance(said, str) else said)), text
    if said in NEEDED_BY_DATASETS:
        assert all(timed.truth is None for timed in open_sequence(copied))


@pytest.mark.parametrize(
    "pose",
    [
        pose_with(None),
        pose_with(math.nan),
        pose_with(-math.inf),
        pose_with(math.nan, 0, 0),
        frame(transform_matrix=None),
        frame(transform_matrix=[[0.0] * 4] * 4),
    ],
)
def test_frames_without_a_pose_are_left_out_and_counted(pose: Edit, tmp_path: Path) -> None:
    folder = LAYOUTS["transforms"].write(tmp_path, small_views(COUNT))
    pose(folder / JSON)
    with pytest.warns(InputWarning, match=r"1 of 6 frames have no pose .* first: images/r_1\.png"):
        assert sorted(read_all(folder)) == ["r_0", "r_2", "r_3", "r_4", "r_5"]
    for number in range(COUNT):
        frame(number, transform_matrix=None)(folder / JSON)
    with refused(where=f"{folder / JSON}: frame 0 (images/r_0.png)", found="no transform_matrix", expected="a 4x4"):
        read_all(folder)


def test_pipes_are_refused_or_left_out_and_do_not_hang(tmp_path: Path) -> None:
    folder = LAYOUTS["transforms"].write(tmp_path, small_views(COUNT))
    for name in ("images/r_2.png", "depth/r_3.png"):
        (folder / name).unlink()
        os.mkfifo(folder / name)
    with pytest.warns(InputWarning, match="missing and left out"):
        assert len(read_all(folder)) == 5
    (folder / JSON).unlink()
    os.mkfifo(folder / JSON)
    message(folder)


# Folders and names


def test_a_folder_that_is_no_dataset(tmp_path: Path) -> None:
    folder = LAYOUTS["transforms"].write(tmp_path / "sound", small_views(2))
    (tmp_path / "scan.zip").write_bytes(b"PK")
    (tmp_path / "pi.h264").write_bytes(b"\0\0\0\1")
    for name in ("empty", "notes"):
        (tmp_path / name).mkdir()
    for name in ("notes/notes.txt", "notes.txt"):
        (tmp_path / name).touch()
    for name, read, found, expected in (
        ("none", read_all, "no such file or folder", "a dataset"),
        ("none", open_sequence, "no such file or folder", "a dataset, images or a video"),
        (f"sound/{JSON}", read_all, f"is a file of a dataset; give its folder, {folder}", None),
        ("scan.zip", read_all, "is an archive", "the folder of a dataset; unpack the archive first"),
        ("notes.txt", open_sequence, "is a file", "the folder of a dataset, or a video (.mp4"),
        ("pi.h264", read_all, "is a video in a container that is not read", "MP4"),
        ("empty", read_all, "the folder is empty", "photos or a dataset in one of"),
        ("empty", open_sequence, "no images in it", "image files or a dataset"),
        ("notes", read_all, "contains no photos and is no dataset", "photos or a dataset in one of"),
        ("sound", partial(open_sequence, camera=SMALL), "a dataset with its own cameras; leave out `camera`", None),
    ):
        with refused(where=tmp_path / name, found=found, expected=expected) as caught:
            read(tmp_path / name)
        assert caught.error.where == str(tmp_path / name)
        assert expected is not None or caught.error.expected is None
        assert len(f"{caught.error.found}{caught.error.expected}".replace(str(tmp_path), "")) < 300


def test_unknown_split_and_frame(tmp_path: Path) -> None:
    dataset = open_dataset(LAYOUTS["transforms"].write(tmp_path, small_views(COUNT)))
    for call in (dataset.frame_names, dataset.views):
        with refused(where=tmp_path, found="no split 'tset'", expected="one of train, test"):
            call("tset")
    for name, said, expected in (
        ("r_11", " among its 5 frames, did you mean 'r_1'?", None),
        ("r_0", ", which is in split 'test'", None),
        ("chair", " among its 5 frames", "a name such as 'r_1'"),
    ):
        with refused(where=f"{tmp_path}: split 'train'", found=f"no frame '{name}'{said}", expected=expected):
            dataset.views("train", ["r_2", name])


# Archives of Record3D


def test_an_archive_that_is_cut_or_none_or_empty(tmp_path: Path) -> None:
    files = record3d_files(small_views(2))
    whole = packed(tmp_path, files).read_bytes()
    for content, found in ((whole[: len(whole) // 2], "ends too early"), (b"no zip at all", "is not a zip")):
        (tmp_path / "scan.r3d").write_bytes(content)
        with refused(where=tmp_path / "scan.r3d", found=found, expected="a Record3D recording (.r3d)"):
            read_all(tmp_path / "scan.r3d")
    file = packed(tmp_path, {"icon": b""})
    with refused(where=file / "metadata", found="not found in the archive, which holds 1 file"):
        read_all(file)
    file = packed(tmp_path, {name: files[name] for name in files if not name.endswith(".jpg")})
    with refused(where=file / "rgbd/0.jpg", found="no such image"):
        read_all(file)


def test_members_that_unpack_to_too_much(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The size that the archive states is checked first, and what comes out of it as well."""
    file = packed(tmp_path, {**record3d_files(small_views(2)), "metadata": bytes(10**6)}, zipfile.ZIP_DEFLATED)
    monkeypatch.setattr("bidnerf_core.io.allowance.FREE", 10**5)
    with refused(where=file / "metadata", found="unpacks to 1 MiB", expected="at most 0 MiB in memory"):
        read_all(file)
    content = file.read_bytes().replace((10**6).to_bytes(4, "little"), (10**4).to_bytes(4, "little"))
    file.write_bytes(content)
    with refused(where=file / "metadata") as caught:
        read_all(file)
    assert caught.error.found.startswith(("cannot be unpacked", "unpacks to"))


def test_the_package_that_decodes_depth_is_named_where_it_is_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "lzfse", None)
    files = record3d_files(small_views(2))
    file = packed(tmp_path, files)
    with refused(where=file, found="pip install 'bidnerf[record3d]'"):
        read_all(file)
    colour = {name: files[name] for name in files if not name.endswith((".depth", ".conf"))}
    assert all(view.frame.depth is None for view in read_all(packed(tmp_path, colour)).values())
