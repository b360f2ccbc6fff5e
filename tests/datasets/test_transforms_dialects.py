"""``transforms.json`` as other programs and other systems write it: names, units of depth, matrices, and missing files."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import pytest
import torch

from bidnerf_core.datasets import open_dataset, open_sequence, unique_names

# Inside: a lookup of names that differ by case, which few file systems can hold
from bidnerf_core.datasets.file_names import FileNames
from refusals import refused
from scan_layouts import (
    SMALL,
    camera_keys,
    edit_keys,
    read_all,
    remarks_of,
    small_views,
    write_nerfstudio,
)

COUNT = 10
Json = dict[str, Any]
Edit = Callable[[Path], object]


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    """Ten images with depth, r_0 to r_9."""
    return write_nerfstudio(tmp_path, small_views(COUNT))


def each_frame(change: Callable[[Json], object], **keys: Any) -> Edit:
    """Change all frames and keys of the file."""

    def edit(folder: Path) -> None:
        frames = json.loads((folder / "transforms.json").read_text())["frames"]
        for frame in frames:
            change(frame)
        edit_keys(folder / "transforms.json", frames=frames, **keys)

    return edit


def paths(change: Callable[[str], str], *keys: str) -> Edit:
    keys = keys or ("file_path", "depth_file_path")
    return each_frame(lambda frame: frame.update({key: change(frame[key]) for key in keys}))


def upper_case(folder: Path) -> None:
    for file in (folder / "images").iterdir():
        file.rename(file.with_suffix(".PNG"))
    paths(lambda path: path.removesuffix(".png"), "file_path")(folder)


def scaled(frame: Json, size: int, factor: float) -> None:
    """Scale the upper rows and columns of the matrix."""
    matrix = np.array(frame["transform_matrix"])
    matrix[:size, :size] *= factor
    frame["transform_matrix"] = matrix.tolist()


def instant_ngp(**keys: Any) -> Edit:
    """NeRFCapture's keys, with depth in half millimetres."""
    return each_frame(
        lambda frame: frame.update(depth_path=frame.pop("depth_file_path")),
        integer_depth_scale=0.0005,
        **keys,
    )


def nerfstudio_converter(folder: Path) -> None:
    """A camera in each frame, and keys that tell what the converter did; the world is the file's."""
    each_frame(lambda frame: frame.update(colmap_im_id=3, **camera_keys(SMALL)))(folder)
    nothing: dict[str, Any] = dict.fromkeys(("fl_x", "fl_y", "cx", "cy", "w", "h"))
    applied = [[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]]
    edit_keys(
        folder / "transforms.json",
        **nothing,
        orientation_override="none",
        ply_file_path="sparse_pc.ply",
        applied_transform=applied,
    )


DIALECTS: dict[str, tuple[Edit, str]] = {
    "Windows separators": (paths(lambda path: path.replace("/", "\\")), "is taken for images/r_"),
    "absolute on Windows": (
        paths(lambda path: "C:\\Users\\me\\capture\\" + path.replace("/", "\\")),
        "is taken for images/r_",
    ),
    "absolute elsewhere": (paths(lambda path: "/home/somebody/capture/" + path), "is taken for images/r_"),
    "upper case, no extension": (upper_case, ""),
    "folder in another case": (
        paths(lambda path: path.replace("images", "Images"), "file_path"),
        "'Images/r_0.png' is taken for images/r_0.png",
    ),
    "homogeneous": (
        each_frame(lambda frame: scaled(frame, 4, 0.00118)),
        "all 10 matrices have a scale (frame images/r_0.png: 0.00118)",
    ),
    "scaled rotation": (
        each_frame(lambda frame: scaled(frame, 3, 3.5)),
        "all 10 matrices have a scale (frame images/r_0.png: 3.5)",
    ),
    "instant-ngp": (instant_ngp(enable_depth_loading=True), ""),
    "nerfstudio's converter": (nerfstudio_converter, ""),
}


@pytest.mark.parametrize("dialect", DIALECTS)
def test_dialects_give_the_same_views(dialect: str, capture: Path) -> None:
    edit, expected = DIALECTS[dialect]
    usual = read_all(capture)
    edit(capture)
    remarks = remarks_of(capture)
    assert len(remarks) == (expected != "")
    assert all(expected in remark for remark in remarks)
    found = read_all(capture)
    assert found.keys() == usual.keys()
    for name, view in found.items():
        assert torch.equal(view.frame.rgb, usual[name].frame.rgb)
        assert view.frame.intrinsics == usual[name].frame.intrinsics
        depth, expected_depth = view.frame.depth, usual[name].frame.depth
        torch.testing.assert_close(depth * 2 if dialect == "instant-ngp" else depth, expected_depth)
        torch.testing.assert_close(view.T_ref_camera.matrix(), usual[name].T_ref_camera.matrix(), atol=1e-9, rtol=0)


def test_depth_has_the_unit_of_either_program(capture: Path) -> None:
    usual = read_all(capture)
    each_frame(lambda frame: frame.pop("depth_unit_scale_factor", None), integer_depth_scale=0.0005)(capture)
    for name, view in read_all(capture).items():
        torch.testing.assert_close(view.frame.depth * 2, usual[name].frame.depth)


def test_depth_that_is_switched_off_is_not_read(capture: Path) -> None:
    instant_ngp(enable_depth_loading=False)(capture)
    assert remarks_of(capture) == []
    assert all(view.frame.depth is None for view in read_all(capture).values())


def test_a_given_unit_of_depth_replaces_that_of_the_file(capture: Path) -> None:
    usual = read_all(capture)
    for views in (
        read_all(capture, depth_unit=0.002),
        {timed.frame.name: timed for timed in open_sequence(capture, depth_unit=0.002)},
    ):
        for name, found in views.items():
            torch.testing.assert_close(found.frame.depth, 2 * usual[name].frame.depth)
    for unit in (0.0, -1.0, float("nan")):
        with refused(found=f"depth_unit is {unit:g}", expected="a positive number of metres"):
            open_dataset(capture, depth_unit=unit)


@pytest.mark.parametrize("unit", [["metres"], {"length": "metres"}, "feet", 3])
def test_a_unit_of_length_that_is_none_is_ignored(capture: Path, unit: object) -> None:
    usual = open_dataset(capture).unit
    edit_keys(capture / "transforms.json", unit=unit)
    assert open_dataset(capture).unit == usual


def test_lists_of_names_that_no_frame_has(capture: Path) -> None:
    listed = ["images/r_1.png", "images/nix.png", "images\\r_2.png", 7]
    edit_keys(capture / "transforms.json", train_filenames=listed)
    (remark,) = remarks_of(capture)
    assert "have 2 that no frame has, the first of them 'images/nix.png'" in remark
    with pytest.warns(match="nix"):
        dataset = open_dataset(capture)
    assert dataset.splits == ("train",)
    assert dataset.frame_names("train") == ["r_1", "r_2"]


def test_files_that_differ_by_case_alone_are_not_guessed(tmp_path: Path) -> None:
    for name in ("a.png", "A.png", "b.png"):
        (tmp_path / name).touch()
    names = FileNames(tmp_path)
    assert names.find(PurePosixPath("a.png")) == tmp_path / "a.png"
    assert names.find(PurePosixPath("B.PNG")) == tmp_path / "b.png"
    assert names.find(PurePosixPath("a.PNG")) is None


def test_equal_names_in_several_folders_differ() -> None:
    paths = [("a", "b", "1"), ("a", "c", "1"), ("b", "b", "1"), ("2",), ("a", "b_1"), ("a_b", "1")]
    names = unique_names(paths)
    assert len(set(names)) == len(names)
    assert names[3] == "2"
