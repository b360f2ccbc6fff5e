"""Reading ``transforms.json``: axes, colours, depth, cameras, splits and names."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest
import torch

# Inside: how often the frames of a split are named
import bidnerf_core.datasets.capture as capture_module
from bidnerf_core.datasets import open_dataset
from bidnerf_core.errors import InputWarning
from bidnerf_core.frames import Frame
from refusals import refused
from scan_layouts import edit_frame, edit_keys, opengl, read_all, small_views, write_image, write_nerfstudio

W, H, ANGLE = 16, 12, 0.9
JSON = "transforms.json"


def random_pixels(number: int, channels: int) -> np.ndarray:
    image = np.random.default_rng(number).integers(0, 256, (H, W, channels), dtype=np.uint8)
    return image[..., 0] if channels == 1 else image


@pytest.fixture
def blender(tmp_path: Path) -> Path:
    """NeRF's dialect: three files, extensions left out, one angle."""
    folder, poses = tmp_path / "blender", [opengl(view).tolist() for view in small_views(6)]
    for split, numbers in (("train", (0, 1, 2)), ("val", (3,)), ("test", (4, 5))):
        frames = [{"file_path": f"./{split}/r_{n}", "transform_matrix": poses[n]} for n in numbers]
        for n in numbers:
            write_image(folder / split / f"r_{n}.png", random_pixels(n, 4))
        content = {"camera_angle_x": ANGLE, "frames": frames}
        (folder / f"transforms_{split}.json").write_text(json.dumps(content))
    return folder


@pytest.fixture
def nerfstudio(tmp_path: Path) -> Path:
    """nerfstudio's dialect: one file; of r_0 to r_5, r_0 is the test."""
    return write_nerfstudio(tmp_path / "nerfstudio", small_views(6))


def first(folder: Path, **options: Any) -> Frame:
    return open_dataset(folder, **options).views("test")[0].frame


def test_the_frames_of_a_split_are_named_once(blender: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Naming takes time for each frame of the split, so that reading all of them would take its square."""
    named = list[int]()
    capture, usual = open_dataset(blender), capture_module.unique_names
    monkeypatch.setattr(capture_module, "unique_names", lambda paths: named.append(len(paths)) or usual(paths))
    for name in capture.frame_names("train"):
        assert capture.views("train", [name])[0].frame.name == name
    assert named == [3]


# Axes and poses


def test_a_camera_in_opengl_axes_sees_what_it_should(nerfstudio: Path) -> None:
    """It is at (0, 1, 4), turned by nothing, and looks along -z."""
    edit_frame(nerfstudio / JSON, 0, transform_matrix=[[1, 0, 0, 0], [0, 1, 0, 1], [0, 0, 1, 4]])
    view = open_dataset(nerfstudio).views("test")[0]
    assert view.T_ref_camera.rotation.dtype == torch.float64
    seen = view.T_ref_camera.inverse().apply(torch.tensor([[0.0, 1, 0], [1, 1, 0], [0, 2, 0]]).double())
    torch.testing.assert_close(seen, torch.tensor([[0.0, 0, 4], [1, 0, 4], [0, -1, 4]]).double())
    camera = view.frame.intrinsics
    at = camera.project(seen)
    torch.testing.assert_close(at[0], torch.tensor([camera.cx, camera.cy]).double())
    assert at[1, 0] > camera.cx  # right stays right
    assert at[2, 1] < camera.cy  # up in the world is up in the image


def test_rounded_rotations_are_made_orthonormal(nerfstudio: Path) -> None:
    exact = open_dataset(nerfstudio).views("test")[0].T_ref_camera
    rounded = [[round(x, 3) for x in row] for row in opengl(small_views(1)[0]).tolist()]
    edit_frame(nerfstudio / JSON, 0, transform_matrix=rounded)
    pose = open_dataset(nerfstudio).views("test")[0].T_ref_camera
    assert pose.is_rigid(1e-12)
    torch.testing.assert_close(pose.rotation, exact.rotation, atol=1e-3, rtol=0)


# Colours


@pytest.mark.parametrize(
    ("given", "expected"),
    [(None, (1, 1, 1)), ("black", (0, 0, 0)), ("white", (1, 1, 1)), ((0.1, 0.2, 1), (0.1, 0.2, 1))],
)
def test_colours_are_laid_over_the_background_where_there_is_alpha(
    blender: Path, given: Any, expected: tuple[float, ...]
) -> None:
    (blender / "train/r_0.png").unlink()  # the background is known all the same
    with pytest.warns(InputWarning, match="1 of 6 images is missing"):
        dataset = open_dataset(blender, given)
    frame = dataset.views("train", ["r_1"])[0].frame
    raw = torch.from_numpy(random_pixels(1, 4).astype(np.float32)) / 255
    assert dataset.background == expected
    torch.testing.assert_close(frame.alpha, raw[..., 3])
    over = raw[..., :3] * raw[..., 3:] + torch.tensor(expected) * (1 - raw[..., 3:])
    torch.testing.assert_close(frame.rgb, over, atol=0.501 / 255, rtol=0)  # rounded to bytes


# Depth


def test_depth_is_in_metres_and_holes_are_zero(nerfstudio: Path) -> None:
    """The default unit is a millimetre, a frame has the say over the file, and frames may have none."""
    edit_frame(nerfstudio / JSON, 1, depth_unit_scale_factor=0.5)
    edit_frame(nerfstudio / JSON, 2, depth_file_path=None)
    raw = {name: iio.imread(nerfstudio / f"depth/{name}.png") for name in ("r_0", "r_1")}
    for depth in raw.values():
        depth[0, :3], depth[0, 3:6] = 0, 65535
        depth[0, 6:9] = 1
    for name, depth in raw.items():
        iio.imwrite(nerfstudio / f"depth/{name}.png", depth)
    for unit in (None, 0.002):
        edit_keys(nerfstudio / JSON, depth_unit_scale_factor=unit)
        views = read_all(nerfstudio)
        assert views["r_2"].frame.depth is None
        for name, metres in (("r_0", unit or 0.001), ("r_1", 0.5)):
            expected = torch.from_numpy(np.where(raw[name] == 65535, 0, raw[name]) * metres).float()
            torch.testing.assert_close(views[name].frame.depth, expected)
    iio.imwrite(nerfstudio / "depth/r_0.png", np.zeros((H, W), dtype=np.uint16))
    assert not first(nerfstudio).has_depth


# Cameras


def test_lens_distortion_is_ordered_as_opencv_does(nerfstudio: Path) -> None:
    for keys, lens in (
        ({"k1": 0.1, "k2": 0.2, "p1": 0.3, "p2": 0.4}, (0.1, 0.2, 0.3, 0.4)),
        (
            {"k2": None, "p1": None, "p2": None, "k3": 0.5, "camera_model": "SIMPLE_RADIAL"},
            (0.1, 0, 0, 0, 0.5),
        ),
        ({"k1": 0, "k2": 0, "p1": 0, "p2": 0, "k3": 0}, ()),
    ):
        edit_keys(nerfstudio / JSON, **keys)
        assert first(nerfstudio).intrinsics.distortion == lens


def test_a_frame_has_the_say_over_the_file(nerfstudio: Path) -> None:
    before = first(nerfstudio).intrinsics
    edit_frame(nerfstudio / JSON, 1, camera_angle_x=1.2, cx=3, fl_y=5)
    cameras = {name: view.frame.intrinsics for name, view in read_all(nerfstudio).items()}
    assert cameras["r_1"].fx == pytest.approx(W / 2 / math.tan(0.6))
    assert (cameras["r_1"].fy, cameras["r_1"].cx, cameras["r_1"].cy) == (5, 3, before.cy)
    assert cameras["r_0"] == before


def test_what_may_be_left_out_or_written_otherwise(nerfstudio: Path) -> None:
    """A principal point in the middle, square pixels, the size of the images; sizes as floats; a mark in front of the text."""
    edit_keys(nerfstudio / JSON, fl_y=None, cx=None, cy=None, w=None, h=None, camera_model=None)
    camera = first(nerfstudio).intrinsics
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (20, 20, W / 2, H / 2)
    edit_keys(nerfstudio / JSON, w=float(W), h=float(H))
    text = (nerfstudio / JSON).read_text()
    (nerfstudio / JSON).write_text(text, encoding="utf-8-sig")  # as some editors write it
    assert first(nerfstudio).intrinsics == camera


# Dialects, splits and names


def test_dialects_give_equal_views(blender: Path, nerfstudio: Path) -> None:
    for n in range(6):
        iio.imwrite(nerfstudio / f"images/r_{n}.png", random_pixels(n, 4))
    angle = {"fl_x": None, "fl_y": None, "camera_angle_x": ANGLE, "cx": None, "cy": None}
    edit_keys(nerfstudio / JSON, **angle)
    one, other = read_all(blender), read_all(nerfstudio)
    assert one.keys() == other.keys()
    for name, view in one.items():
        assert view.frame.intrinsics == other[name].frame.intrinsics
        assert torch.equal(view.frame.rgb, other[name].frame.rgb)
        assert torch.equal(view.T_ref_camera.matrix(), other[name].T_ref_camera.matrix())


def test_splits_of_several_files(blender: Path) -> None:
    """They come before the single file."""
    (blender / JSON).write_text("{}")
    dataset = open_dataset(blender)
    assert dataset.splits == ("train", "val", "test")
    assert dataset.frame_names("train") == ["r_0", "r_1", "r_2"]
    (blender / "transforms_train.json").unlink()
    (blender / "transforms_val.json").unlink()
    assert open_dataset(str(blender)).splits == ("test",)


def test_splits_by_lists(nerfstudio: Path) -> None:
    lists = {"train_filenames": ["./images/r_3.png", "images/r_1.png"], "test_filenames": ["images/r_0.png"]}
    edit_keys(nerfstudio / JSON, **lists)
    dataset = open_dataset(nerfstudio)
    assert dataset.splits == ("train", "test")
    assert dataset.frame_names("train") == ["r_3", "r_1"]


def test_a_single_frame_is_in_both_splits(tmp_path: Path) -> None:
    alone = open_dataset(write_nerfstudio(tmp_path, small_views(1)))
    assert alone.frame_names("train") == alone.frame_names("test") == ["r_0"]
    assert len(alone.views("all")) == 1


def test_only_what_is_asked_for_is_read_and_in_that_order(blender: Path) -> None:
    (blender / "train/r_1.png").write_bytes(b"damaged")
    views = open_dataset(blender).views("train", ["r_2", "r_0"])
    assert [view.frame.name for view in views] == ["r_2", "r_0"]
    assert open_dataset(blender).views("train", []) == []


def test_names_with_dots_and_twins(nerfstudio: Path) -> None:
    paths = ["left/0.5", "right/0.5", "left/7.png", "c.d.png"]
    for number, path in enumerate(paths):
        edit_frame(nerfstudio / JSON, number, file_path=path)
        write_image(nerfstudio / f"{path.removesuffix('.png')}.png", random_pixels(number, 3))
    edit_keys(nerfstudio / JSON, train_filenames=paths)
    dataset = open_dataset(nerfstudio)
    assert dataset.frame_names("train") == ["left_0.5", "right_0.5", "7", "c.d"]
    assert len(dataset.views("train")) == 4
    with refused(where=nerfstudio, found="frame '0.5' is ambiguous", expected="one of left_0.5, right_0.5"):
        dataset.views("train", ["0.5"])
