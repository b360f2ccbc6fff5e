"""``transforms.json`` as other programs and other systems write it: names, units of depth, matrices, and missing files."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable
from pathlib import Path, PurePosixPath
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest
import torch

from bidnerf_core.datasets import Dataset, open_dataset, open_sequence, unique_names
from bidnerf_core.datasets.file_names import FileNames
from bidnerf_core.errors import InputError
from bidnerf_core.frames import View

W, H = 16, 12
Json = dict[str, Any]
Edit = Callable[[Path, Json], Any]


def write_capture(folder: Path, edit: Edit | None = None) -> Path:
    """Write ten images with depth; ``edit`` changes the files and the description before that is written."""
    frames = []
    for number in range(10):
        for kind in ("images", "depth"):
            (folder / kind).mkdir(parents=True, exist_ok=True)
        pose = np.eye(4)
        pose[0, 3] = number / 10
        iio.imwrite(folder / f"images/{number:04d}.png", np.full((H, W, 3), 20 * number, np.uint8))
        steps = np.random.default_rng(number).integers(500, 3000, (H, W)).astype(np.uint16)
        iio.imwrite(folder / f"depth/{number:04d}.png", steps)
        frames.append(
            {
                "file_path": f"images/{number:04d}.png",
                "depth_file_path": f"depth/{number:04d}.png",
                "transform_matrix": pose.tolist(),
            }
        )
    content: Json = {"fl_x": 20.0, "w": W, "h": H, "frames": frames}
    if edit is not None:
        edit(folder, content)
    (folder / "transforms.json").write_text(json.dumps(content))
    return folder


def opened(folder: Path, **options: Any) -> tuple[Dataset, list[str]]:
    """Return the dataset, every image of which was read once, and the remarks that it caused."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        dataset = open_dataset(folder, **options)
        views_of(dataset)
    return dataset, [str(warning.message) for warning in caught]


def views_of(dataset: Dataset) -> dict[str, View]:
    return {view.frame.name: view for split in dataset.splits for view in dataset.views(split)}


def each_frame(change: Callable[[Json], Any]) -> Edit:
    return lambda folder, content: [change(frame) for frame in content["frames"]]


def windows(frame: Json) -> None:
    for key in ("file_path", "depth_file_path"):
        frame[key] = frame[key].replace("/", "\\")


def elsewhere(frame: Json) -> None:
    for key in ("file_path", "depth_file_path"):
        frame[key] = "C:\\Users\\me\\capture\\" + frame[key].replace("/", "\\")


def other_machine(frame: Json) -> None:
    for key in ("file_path", "depth_file_path"):
        frame[key] = "/home/somebody/capture/" + frame[key]


def upper_case(folder: Path, content: Json) -> None:
    for file in (folder / "images").iterdir():
        file.rename(file.with_suffix(".PNG"))
    for frame in content["frames"]:
        frame["file_path"] = frame["file_path"].removesuffix(".png")


def capital_folder(frame: Json) -> None:
    frame["file_path"] = frame["file_path"].replace("images", "Images")


def homogeneous(frame: Json) -> None:
    frame["transform_matrix"] = (np.array(frame["transform_matrix"]) * 0.00118).tolist()


def scaled_rotation(frame: Json) -> None:
    matrix = np.array(frame["transform_matrix"])
    matrix[:3, :3] *= 3.5
    frame["transform_matrix"] = matrix.tolist()


def instant_ngp(folder: Path, content: Json) -> None:
    """NeRFCapture's keys, with depth in half millimetres."""
    for frame in content["frames"]:
        frame["depth_path"] = frame.pop("depth_file_path")
    content |= {"integer_depth_scale": 0.0005, "enable_depth_loading": True}


DIALECTS: dict[str, tuple[Edit, str]] = {
    "as usual": (lambda folder, content: None, ""),
    "Windows separators": (each_frame(windows), "is taken for images/000"),
    "absolute on Windows": (each_frame(elsewhere), "is taken for images/000"),
    "absolute elsewhere": (each_frame(other_machine), "is taken for images/000"),
    "upper case, no extension": (upper_case, ""),
    "folder in another case": (each_frame(capital_folder), "'Images/0001.png' is taken for images/0001.png"),
    "homogeneous": (each_frame(homogeneous), "all 10 matrices have a scale (frame images/0000.png: 0.00118)"),
    "scaled rotation": (
        each_frame(scaled_rotation),
        "all 10 matrices have a scale (frame images/0000.png: 3.5)",
    ),
}


@pytest.fixture(scope="module")
def usual(tmp_path_factory: pytest.TempPathFactory) -> dict[str, View]:
    return views_of(open_dataset(write_capture(tmp_path_factory.mktemp("usual"))))


@pytest.mark.parametrize("dialect", DIALECTS)
def test_dialects_give_the_same_views(dialect: str, usual: dict[str, View], tmp_path: Path) -> None:
    edit, expected = DIALECTS[dialect]
    dataset, remarks = opened(write_capture(tmp_path, edit))
    assert len(remarks) == (expected != "")
    assert all(expected in remark and "\n" not in remark for remark in remarks)
    found = views_of(dataset)
    assert found.keys() == usual.keys()
    for name, view in found.items():
        assert torch.equal(view.frame.rgb, usual[name].frame.rgb)
        torch.testing.assert_close(view.frame.depth, usual[name].frame.depth)
        torch.testing.assert_close(
            view.T_ref_camera.matrix(), usual[name].T_ref_camera.matrix(), atol=1e-9, rtol=0
        )


def test_depth_of_instant_ngp(usual: dict[str, View], tmp_path: Path) -> None:
    dataset, remarks = opened(write_capture(tmp_path, instant_ngp))
    assert not remarks
    for name, view in views_of(dataset).items():
        expected = usual[name].frame.depth
        assert view.frame.depth is not None
        assert expected is not None
        torch.testing.assert_close(view.frame.depth, expected / 2)


def test_depth_that_is_switched_off_is_not_read(tmp_path: Path) -> None:
    def edit(folder: Path, content: Json) -> None:
        instant_ngp(folder, content)
        content["enable_depth_loading"] = False

    dataset, remarks = opened(write_capture(tmp_path, edit))
    assert all(view.frame.depth is None for view in views_of(dataset).values())
    assert len(remarks) == 1
    assert "enable_depth_loading is false" in remarks[0]


def test_depth_of_another_size_is_that_of_the_nearest_measurement(tmp_path: Path) -> None:
    def edit(folder: Path, content: Json) -> None:
        for file in (folder / "depth").iterdir():
            iio.imwrite(file, (1000 + np.arange(12, dtype=np.uint16)).reshape(3, 4))

    dataset, _ = opened(write_capture(tmp_path, edit))
    depth = views_of(dataset)["0003"].frame.depth
    assert depth is not None
    expected = (1 + np.arange(12, dtype=np.float32).reshape(3, 4) / 1000).repeat(4, 0).repeat(4, 1)
    np.testing.assert_allclose(depth, expected, rtol=1e-6)


def test_a_given_unit_of_depth_replaces_that_of_the_file(usual: dict[str, View], tmp_path: Path) -> None:
    folder = write_capture(tmp_path)
    for views in (
        views_of(open_dataset(folder, depth_unit=0.002)),
        {timed.frame.name: timed for timed in open_sequence(folder, depth_unit=0.002)},
    ):
        for name, found in views.items():
            expected = usual[name].frame.depth
            assert found.frame.depth is not None
            assert expected is not None
            torch.testing.assert_close(found.frame.depth, 2 * expected)
    for unit in (0.0, -1.0, float("nan")):
        with pytest.raises(InputError, match=r"depth_unit is .* expected a positive number of metres"):
            open_dataset(folder, depth_unit=unit)


def test_missing_images_are_left_out_and_counted(tmp_path: Path) -> None:
    folder = write_capture(tmp_path)
    for number in (2, 3, 4):
        (folder / f"images/{number:04d}.png").unlink()
    dataset, remarks = opened(folder)
    assert sorted(views_of(dataset)) == [f"{number:04d}" for number in (0, 1, 5, 6, 7, 8, 9)]
    assert len(remarks) == 1
    assert "3 of 10 images are missing and left out" in remarks[0]
    assert remarks[0].endswith("first: images/0002.png")
    for file in (folder / "images").iterdir():
        file.unlink()
    with pytest.raises(InputError, match=r"frame 1 .*: no image .*0001\.png, expected that file"):
        open_dataset(folder)


def test_frames_without_their_depth_image_have_colour_alone(tmp_path: Path) -> None:
    folder = write_capture(tmp_path)
    (folder / "depth/0006.png").unlink()
    dataset, remarks = opened(folder)
    assert [name for name, view in views_of(dataset).items() if view.frame.depth is None] == ["0006"]
    assert len(remarks) == 1
    assert "1 of 10 depth images is missing and left out, first: depth/0006.png" in remarks[0]


def test_lists_of_names_that_no_frame_has(tmp_path: Path) -> None:
    def edit(folder: Path, content: Json) -> None:
        content["train_filenames"] = ["images/0001.png", "images/nix.png", "images\\0002.png", 7]

    dataset, remarks = opened(write_capture(tmp_path, edit))
    assert dataset.splits == ("train",)
    assert dataset.frame_names("train") == ["0001", "0002"]
    assert len(remarks) == 1
    assert (
        "train_filenames lists 'images/nix.png' and 1 more, which no frame has; the other 2 are used"
        in remarks[0]
    )


@pytest.mark.parametrize("last", [[0, 0, 0, 0], [0, 0, 0, -1], [0.1, 0, 0, 1], [0, 0, 1, 0]])
def test_other_last_rows_are_refused(last: list[float], tmp_path: Path) -> None:
    def edit(folder: Path, content: Json) -> None:
        content["frames"][1]["transform_matrix"][3] = last

    with pytest.raises(InputError, match=r"the last row of transform_matrix is \[.*expected \[0, 0, 0, 1\]"):
        open_dataset(write_capture(tmp_path, edit))


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
