"""Reading datasets: conventions, dialects, and what is said of every kind of bad input."""

from __future__ import annotations

import copy
import json
import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from PIL import Image

from bidnerf_core.datasets import READERS, Dataset, Reader, ReadOptions, open_dataset
from bidnerf_core.errors import InputError, InputWarning
from bidnerf_core.frames import View

W, H, ANGLE = 12, 8, 0.9
FOCAL = W / 2 / math.tan(ANGLE / 2)
Json = dict[str, Any]


def camera_to_world(number: int) -> list[list[float]]:
    """OpenGL axes: a few steps up and to the side, turned about the vertical by ``number`` tenths of a radian."""
    c, s = math.cos(number / 10), math.sin(number / 10)
    return [[c, 0, s, 0.1 * number], [0, 1, 0, 1.0], [-s, 0, c, 4.0], [0, 0, 0, 1]]


def pixels(number: int, channels: int) -> np.ndarray:
    image = np.random.default_rng(number).integers(0, 256, (H, W, channels), dtype=np.uint8)
    return image[..., 0] if channels == 1 else image


def write_images(folder: Path, names: list[str], channels: int) -> None:
    for number, name in enumerate(names):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        iio.imwrite(folder / name, pixels(number, channels))


def write_depth(folder: Path, names: list[str], size: tuple[int, int] = (H, W)) -> None:
    for number, name in enumerate(names):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        depth = np.random.default_rng(100 + number).integers(0, 5000, size).astype(np.uint16)
        depth[0, :3] = 0
        iio.imwrite(folder / name, depth)


def write_json(folder: Path, name: str, content: Any) -> None:
    (folder / name).write_text(json.dumps(content))


@pytest.fixture
def blender(tmp_path: Path) -> Path:
    """NeRF's dialect: three files, extensions left out, one angle."""
    folder = tmp_path / "blender"
    for split, numbers in (("train", (0, 1, 2)), ("val", (3,)), ("test", (4, 5))):
        frames = [{"file_path": f"./{split}/r_{n}", "transform_matrix": camera_to_world(n)} for n in numbers]
        folder.mkdir(exist_ok=True)
        write_json(folder, f"transforms_{split}.json", {"camera_angle_x": ANGLE, "frames": frames})
        for n in numbers:
            (folder / split).mkdir(exist_ok=True)
            iio.imwrite(folder / split / f"r_{n}.png", pixels(n, 4))
    return folder


def nerfstudio_json(count: int = 6) -> Json:
    frames = [
        {
            "file_path": f"images/r_{n}.png",
            "depth_file_path": f"depth/r_{n}.png",
            "transform_matrix": camera_to_world(n),
        }
        for n in range(count)
    ]
    camera = {
        "camera_model": "OPENCV",
        "fl_x": FOCAL,
        "fl_y": FOCAL,
        "cx": W / 2,
        "cy": H / 2,
        "w": W,
        "h": H,
    }
    return {**camera, "frames": frames}


@pytest.fixture
def nerfstudio(tmp_path: Path) -> Callable[..., Path]:
    """nerfstudio's dialect: one file; ``edit`` changes it before it is written."""

    def write(edit: Callable[[Json], Any] | None = None, channels: int = 3, count: int = 6) -> Path:
        folder = tmp_path / "nerfstudio"
        content = nerfstudio_json(count)
        write_images(folder, [frame["file_path"] for frame in content["frames"]], channels)
        write_depth(folder, [frame["depth_file_path"] for frame in content["frames"]])
        if edit is not None:
            content = edit(content) or content
        write_json(folder, "transforms.json", content)
        return folder

    return write


def edit_frame(number: int = 1, **changes: Any) -> Callable[[Json], None]:
    """Set keys of a frame; None takes them away."""

    def edit(content: Json) -> None:
        frame = content["frames"][number]
        frame.update(changes)
        for key, value in changes.items():
            if value is None:
                del frame[key]

    return edit


def edit_file(**changes: Any) -> Callable[[Json], None]:
    def edit(content: Json) -> None:
        content.update(changes)
        for key, value in changes.items():
            if value is None:
                del content[key]

    return edit


def read_all(folder: Path) -> list[View]:
    dataset = open_dataset(folder)
    return [view for split in dataset.splits for view in dataset.views(split)]


def message(folder: Path) -> str:
    """What a user is told of a bad dataset: one line."""
    with pytest.raises(InputError) as caught:
        read_all(folder)
    text = str(caught.value)
    assert "\n" not in text
    assert str(folder) in text
    return text


# Conventions


def test_a_camera_in_opengl_axes_sees_what_it_should(nerfstudio: Callable[..., Path]) -> None:
    view = open_dataset(nerfstudio()).views("test")[0]  # turned by nothing, at (0, 1, 4), looking along -z
    assert view.T_ref_camera.rotation.dtype == torch.float64
    seen = view.T_ref_camera.inverse().apply(torch.tensor([[0.0, 1, 0], [1, 1, 0], [0, 2, 0]]).double())
    torch.testing.assert_close(seen, torch.tensor([[0.0, 0, 4], [1, 0, 4], [0, -1, 4]]).double())
    at = view.frame.intrinsics.project(seen)
    centre = torch.tensor([W / 2, H / 2]).double()
    torch.testing.assert_close(at[0], centre)
    assert at[1, 0] > W / 2  # right stays right
    assert at[2, 1] < H / 2  # up in the world is up in the image


def test_colour_is_laid_over_white_where_there_is_alpha(blender: Path) -> None:
    dataset = open_dataset(blender)
    frame = dataset.views("train", ["r_1"])[0].frame
    raw = torch.from_numpy(pixels(1, 4).astype(np.float32)) / 255
    assert dataset.background == (1, 1, 1)
    assert frame.alpha is not None
    torch.testing.assert_close(frame.alpha, raw[..., 3])
    torch.testing.assert_close(frame.rgb, raw[..., :3] * raw[..., 3:] + 1 - raw[..., 3:])


@pytest.mark.parametrize(
    ("given", "expected"), [("black", (0, 0, 0)), ("white", (1, 1, 1)), ((0.1, 0.2, 1), None)]
)
def test_background_can_be_chosen(blender: Path, given: Any, expected: Any) -> None:
    dataset = open_dataset(blender, given)
    assert dataset.background == (expected or given)
    raw = torch.from_numpy(pixels(0, 4).astype(np.float32)) / 255
    over = raw[..., :3] * raw[..., 3:] + torch.tensor(dataset.background) * (1 - raw[..., 3:])
    torch.testing.assert_close(dataset.views("train", ["r_0"])[0].frame.rgb, over)


@pytest.mark.parametrize("given", ["pink", (0, 0), (0, 0, 2), (0, 0, math.nan)])
def test_other_backgrounds_are_refused(blender: Path, given: Any) -> None:
    with pytest.raises(InputError, match=r'background is .* expected "white", "black" or three numbers'):
        open_dataset(blender, given)


def test_colour_without_alpha_has_a_black_background(nerfstudio: Callable[..., Path]) -> None:
    dataset = open_dataset(nerfstudio())
    assert dataset.background == (0, 0, 0)
    frame = dataset.views("train")[0].frame
    assert frame.alpha is None
    torch.testing.assert_close(frame.rgb, torch.from_numpy(pixels(1, 3).astype(np.float32)) / 255)


@pytest.mark.parametrize("channels", [1, 2])
def test_grey_images_get_three_channels(nerfstudio: Callable[..., Path], channels: int) -> None:
    frame = open_dataset(nerfstudio(channels=channels), "black").views("test")[0].frame
    raw = torch.from_numpy(pixels(0, channels).astype(np.float32)).reshape(H, W, channels) / 255
    grey = raw[..., :1] * raw[..., 1:] if channels == 2 else raw
    torch.testing.assert_close(frame.rgb, grey.expand(H, W, 3))
    assert (frame.alpha is not None) == (channels == 2)


def test_sixteen_bit_grey_is_scaled(nerfstudio: Callable[..., Path]) -> None:
    folder = nerfstudio()
    iio.imwrite(folder / "images/r_0.png", np.full((H, W), 65535, dtype=np.uint16))
    assert open_dataset(folder).views("test", ["r_0"])[0].frame.rgb.unique().tolist() == [1.0]


def test_depth_is_in_metres_and_holes_are_zero(nerfstudio: Callable[..., Path]) -> None:
    def edit(content: Json) -> None:
        content["depth_unit_scale_factor"] = 0.002
        content["frames"][1]["depth_unit_scale_factor"] = 0.5
        del content["frames"][2]["depth_file_path"]

    folder = nerfstudio(edit)
    views = {view.frame.name: view.frame for view in read_all(folder)}
    for name, unit in (("r_0", 0.002), ("r_1", 0.5)):
        raw = iio.imread(folder / f"depth/{name}.png").astype(np.float64) * unit
        depth = views[name].depth
        assert depth is not None
        torch.testing.assert_close(depth, torch.from_numpy(raw).float())
        assert not depth[0, :3].any()
    assert views["r_2"].depth is None


def test_default_unit_of_depth_is_a_millimetre(nerfstudio: Callable[..., Path]) -> None:
    folder = nerfstudio()
    depth = open_dataset(folder).views("test")[0].frame.depth
    torch.testing.assert_close(
        depth, torch.from_numpy(iio.imread(folder / "depth/r_0.png").astype(np.float32)) / 1000
    )


def test_depth_from_an_array(nerfstudio: Callable[..., Path]) -> None:
    folder = nerfstudio(edit_frame(0, depth_file_path="depth/r_0.npy", depth_unit_scale_factor=1))
    array = np.linspace(0.5, 3, W * H).reshape(H, W)
    array[0, :3] = math.nan, -1, math.inf
    np.save(folder / "depth/r_0.npy", array)
    depth = open_dataset(folder).views("test", ["r_0"])[0].frame.depth
    array[0, :3] = 0
    torch.testing.assert_close(depth, torch.from_numpy(array).float())


@pytest.mark.parametrize("nothing", [1e10, float(np.finfo(np.float32).max), 65.535])
def test_values_that_stand_for_no_depth_are_holes(nerfstudio: Callable[..., Path], nothing: float) -> None:
    folder = nerfstudio(edit_frame(0, depth_file_path="depth/r_0.npy", depth_unit_scale_factor=1))
    array = np.full((H, W), 2, dtype=np.float32)
    array[0, :3] = nothing
    np.save(folder / "depth/r_0.npy", array)
    depth = open_dataset(folder).views("test", ["r_0"])[0].frame.depth
    assert depth is not None
    assert depth.unique().tolist() == [0, 2]
    assert not depth[0, :3].any()


def test_the_largest_number_of_sixteen_bits_is_a_hole(nerfstudio: Callable[..., Path]) -> None:
    folder = nerfstudio()
    steps = np.full((H, W), 2000, dtype=np.uint16)
    steps[0, :3] = 65535
    iio.imwrite(folder / "depth/r_0.png", steps)
    depth = open_dataset(folder).views("test", ["r_0"])[0].frame.depth
    assert depth is not None
    assert depth.unique().tolist() == [0, 2]


def test_depth_without_any_measurement_is_no_error(nerfstudio: Callable[..., Path]) -> None:
    folder = nerfstudio()
    iio.imwrite(folder / "depth/r_0.png", np.zeros((H, W), dtype=np.uint16))
    frame = open_dataset(folder).views("test")[0].frame
    assert frame.depth is not None
    assert not frame.has_depth


def test_lens_distortion_is_ordered_as_opencv_does(nerfstudio: Callable[..., Path]) -> None:
    folder = nerfstudio(edit_file(k1=0.1, k2=0.2, p1=0.3, p2=0.4))
    assert open_dataset(folder).views("test")[0].frame.intrinsics.distortion == (0.1, 0.2, 0.3, 0.4)
    folder = nerfstudio(edit_file(k1=0.1, k3=0.5, camera_model="SIMPLE_RADIAL"))
    assert open_dataset(folder).views("test")[0].frame.intrinsics.distortion == (0.1, 0, 0, 0, 0.5)
    folder = nerfstudio(edit_file(k1=0, k2=0, p1=0, p2=0))
    assert open_dataset(folder).views("test")[0].frame.intrinsics.distortion == ()


def test_a_frame_has_the_say_over_the_file(nerfstudio: Callable[..., Path]) -> None:
    views = read_all(nerfstudio(edit_frame(1, camera_angle_x=1.2, cx=3, fl_y=5)))
    cameras = {view.frame.name: view.frame.intrinsics for view in views}
    assert cameras["r_1"].fx == pytest.approx(W / 2 / math.tan(0.6))
    assert (cameras["r_1"].fy, cameras["r_1"].cx, cameras["r_1"].cy) == (5, 3, H / 2)
    assert (cameras["r_0"].fx, cameras["r_0"].cx) == (FOCAL, W / 2)


def test_what_may_be_left_out(nerfstudio: Callable[..., Path]) -> None:
    folder = nerfstudio(edit_file(fl_y=None, cx=None, cy=None, w=None, h=None, camera_model=None))
    camera = open_dataset(folder).views("test")[0].frame.intrinsics
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (FOCAL, FOCAL, W / 2, H / 2)


def test_sizes_may_be_written_as_floats(nerfstudio: Callable[..., Path]) -> None:
    assert open_dataset(nerfstudio(edit_file(w=float(W), h=float(H)))).views("test")


def test_three_rows_of_a_pose_are_enough(nerfstudio: Callable[..., Path]) -> None:
    four, three = (
        open_dataset(nerfstudio()).views("test")[0],
        edit_frame(0, transform_matrix=camera_to_world(0)[:3]),
    )
    torch.testing.assert_close(
        open_dataset(nerfstudio(three)).views("test")[0].T_ref_camera.matrix(), four.T_ref_camera.matrix()
    )


def test_rounded_rotations_are_made_orthonormal(nerfstudio: Callable[..., Path]) -> None:
    rounded = [[round(x, 3) for x in row] for row in camera_to_world(7)]
    pose = open_dataset(nerfstudio(edit_frame(0, transform_matrix=rounded))).views("test")[0].T_ref_camera
    assert pose.is_rigid(1e-12)
    expected = torch.tensor(camera_to_world(7)).double()[:3, :3] * torch.tensor([1, -1, -1])
    torch.testing.assert_close(pose.rotation, expected, atol=1e-3, rtol=0)


# Dialects, splits and names


def test_dialects_give_equal_views(blender: Path, nerfstudio: Callable[..., Path]) -> None:
    def edit(content: Json) -> None:
        for frame in content["frames"]:
            del frame["depth_file_path"]

    one, other = read_all(blender), {view.frame.name: view for view in read_all(nerfstudio(edit, channels=4))}
    assert len(one) == len(other)
    for view in one:
        twin = other[view.frame.name]
        assert view.frame.intrinsics == twin.frame.intrinsics
        assert torch.equal(view.frame.rgb, twin.frame.rgb)
        assert torch.equal(view.T_ref_camera.matrix(), twin.T_ref_camera.matrix())


def test_splits_of_several_files(blender: Path) -> None:
    dataset = open_dataset(blender)
    assert isinstance(dataset, Dataset)
    assert dataset.splits == ("train", "val", "test")
    assert dataset.frame_names("train") == ["r_0", "r_1", "r_2"]
    (blender / "transforms_train.json").unlink()
    (blender / "transforms_val.json").unlink()
    assert open_dataset(str(blender)).splits == ("test",)


def test_splits_by_lists(nerfstudio: Callable[..., Path]) -> None:
    lists = {"train_filenames": ["./images/r_3.png", "images/r_1.png"], "test_filenames": ["images/r_0.png"]}
    dataset = open_dataset(nerfstudio(edit_file(**lists)))
    assert dataset.splits == ("train", "test")
    assert dataset.frame_names("train") == ["r_3", "r_1"]


def test_every_eighth_frame_is_held_out(nerfstudio: Callable[..., Path]) -> None:
    dataset = open_dataset(nerfstudio(count=18))
    assert dataset.frame_names("test") == ["r_0", "r_8", "r_16"]
    assert len(dataset.frame_names("train")) == 15
    alone = open_dataset(nerfstudio(count=1))
    assert alone.frame_names("train") == alone.frame_names("test") == ["r_0"]


def test_files_of_splits_come_before_the_single_file(blender: Path) -> None:
    write_json(blender, "transforms.json", {})
    assert open_dataset(blender).splits == ("train", "val", "test")


@pytest.mark.parametrize("suffix", [".jpg", ".jpeg", ".png"])
def test_extensions_are_found(blender: Path, suffix: str) -> None:
    (blender / "test/r_4.png").unlink()
    iio.imwrite(blender / f"test/r_4{suffix}", pixels(4, 3))
    assert open_dataset(blender).views("test")[0].frame.name == "r_4"


def test_only_what_is_asked_for_is_read_and_in_that_order(blender: Path) -> None:
    (blender / "train/r_1.png").write_bytes(b"damaged")
    told = []
    views = open_dataset(blender).views(
        "train", ["r_2", "r_0"], lambda done, total: told.append((done, total))
    )
    assert [view.frame.name for view in views] == ["r_2", "r_0"]
    assert told == [(1, 2), (2, 2)]
    assert open_dataset(blender).views("train", []) == []


def test_names_with_dots_and_twins(nerfstudio: Callable[..., Path]) -> None:
    paths = ["left/0.5", "right/0.5", "left/7.png", "c.d.png"]

    def edit(content: Json) -> None:
        content["train_filenames"] = paths
        for frame, path in zip(content["frames"], paths, strict=False):
            frame["file_path"] = path

    folder = nerfstudio(edit)
    write_images(folder, ["left/0.5.png", "right/0.5.png", "left/7.png", "c.d.png"], 3)
    dataset = open_dataset(folder)
    assert dataset.frame_names("train") == ["left_0.5", "right_0.5", "7", "c.d"]
    assert len(dataset.views("train")) == 4
    with pytest.raises(InputError, match=r"frame '0.5' is ambiguous, expected one of left_0.5, right_0.5"):
        dataset.views("train", ["0.5"])


def test_another_reader_can_join(tmp_path: Path, blender: Path) -> None:
    class Other(Reader):
        expected = "magic.bin"

        def recognises(self, path: Path) -> bool:
            return (path / "magic.bin").exists()

        def open(self, path: Path, options: ReadOptions) -> Dataset:
            return open_dataset(blender)

    (tmp_path / "magic.bin").touch()
    assert open_dataset(tmp_path, readers=[*READERS.values(), Other()]).path == blender


# Bad input


def test_bad_folders(tmp_path: Path, blender: Path) -> None:
    assert message(tmp_path / "none") == f"{tmp_path / 'none'}: no such folder"
    assert "is a file of a dataset; give its folder" in message(blender / "transforms_test.json")
    empty = tmp_path / "empty"
    empty.mkdir()
    assert message(empty).startswith(f"{empty}: the folder is empty; expected photos or a dataset in one of")
    (empty / "notes.txt").touch()
    assert message(empty).startswith(f"{empty}: contains no photos and is no dataset; expected photos or a")
    assert len(message(empty)) - len(str(empty)) < 300


def test_unknown_split_and_frame(blender: Path) -> None:
    dataset = open_dataset(blender)
    with pytest.raises(InputError, match=r"blender: no split 'tset', expected one of train, val, test"):
        dataset.frame_names("tset")
    with pytest.raises(InputError, match=r"no split 'tset'"):
        dataset.views("tset")
    with pytest.raises(
        InputError, match=r"split 'train': no frame 'r_11' among its 3 frames, did you mean 'r_1'\?"
    ):
        dataset.views("train", ["r_0", "r_11"])
    with pytest.raises(InputError, match="split 'train': no frame 'r_4', which is in split 'test'"):
        dataset.views("train", ["r_4"])
    with pytest.raises(
        InputError, match=r"no frame 'chair' among its 3 frames, expected a name such as 'r_0'"
    ):
        dataset.views("train", ["chair"])


BAD_TEXT = {
    '{"frames": [}': "transforms.json: not JSON (Expecting value at line 1, column 13)",
    '{\n"fl_x": 1,,\n}': "at line 2, column 11)",
    "": "(Expecting value at line 1, column 1)",
    "[1, 2]": "transforms.json: holds [1, 2], expected a JSON object",
    "[" * 100_000: "not JSON (maximum recursion depth",
}


@pytest.mark.parametrize(("text", "expected"), BAD_TEXT.items(), ids=range(len(BAD_TEXT)))
def test_bad_json(tmp_path: Path, text: str, expected: str) -> None:
    (tmp_path / "transforms.json").write_text(text)
    assert expected in message(tmp_path)


def test_json_of_another_encoding(tmp_path: Path, nerfstudio: Callable[..., Path]) -> None:
    (tmp_path / "transforms.json").write_bytes(b'{"a": "\xff\xfe"}')
    assert "not JSON (" in message(tmp_path)
    folder = nerfstudio()
    text = (folder / "transforms.json").read_text()
    (folder / "transforms.json").write_text(text, encoding="utf-8-sig")  # some editors put a mark in front
    assert read_all(folder)


def turned(scale: float = 1.0, mirror: bool = False) -> list[list[float]]:
    matrix = copy.deepcopy(camera_to_world(1))
    for row in matrix[:3]:
        row[:3] = [scale * x for x in row[:3]]
        row[0] *= -1 if mirror else 1
    return matrix


def matrix_with(value: Any, row: int = 1, column: int = 3) -> list[list[Any]]:
    matrix: list[list[Any]] = camera_to_world(1)
    matrix[row][column] = value
    return matrix


@pytest.mark.parametrize(
    "given",
    [
        None,
        matrix_with(math.nan),
        matrix_with(-math.inf),
        matrix_with(math.nan, 0, 0),
        [[0.0] * 4 for _ in range(4)],
    ],
)
def test_frames_without_a_pose_are_left_out_and_counted(nerfstudio: Callable[..., Path], given: Any) -> None:
    with pytest.warns(InputWarning, match=r"1 of 6 frames have no pose .* first: images/r_1\.png"):
        dataset = open_dataset(nerfstudio(edit_frame(transform_matrix=given)))
    names = [name for split in dataset.splits for name in dataset.frame_names(split)]
    assert sorted(names) == ["r_0", "r_2", "r_3", "r_4", "r_5"]


def test_a_description_without_any_pose_is_refused(nerfstudio: Callable[..., Path]) -> None:
    def edit(content: Json) -> None:
        for frame in content["frames"]:
            del frame["transform_matrix"]

    with pytest.raises(InputError, match="no transform_matrix, expected a 4x4"):
        open_dataset(nerfstudio(edit))


BAD_DESCRIPTIONS: dict[str, tuple[Callable[[Json], Any], str]] = {
    "no frames": (edit_file(frames=None), "transforms.json: no frames, expected a list of objects"),
    "empty frames": (edit_file(frames=[]), "frames is empty, expected a list of objects"),
    "frames no list": (edit_file(frames={"a": 1}), 'frames is {"a": 1}, expected a list'),
    "frame no object": (edit_file(frames=["a"]), "frame 0: is not an object, expected one with file_path"),
    "no file_path": (edit_frame(file_path=None), "frame 1: no file_path, expected the name of its image"),
    "file_path a number": (edit_frame(file_path=3), "frame 1: file_path is 3, expected text"),
    "image twice": (
        edit_frame(file_path="./images/r_0"),
        "frame 1 (./images/r_0): has the same image as frame 0, expected each image once",
    ),
    "pose of 2x2": (edit_frame(transform_matrix=[[1, 0], [0, 1]]), "transform_matrix is not 3x4 or 4x4"),
    "flat pose": (edit_frame(transform_matrix=[1.0] * 16), "transform_matrix is not 3x4 or 4x4"),
    "pose no list": (edit_frame(transform_matrix="up"), 'transform_matrix is "up", expected a list'),
    "text in pose": (
        edit_frame(transform_matrix=matrix_with("2")),
        'an entry of transform_matrix is "2", expected a finite number',
    ),
    "null in pose": (edit_frame(transform_matrix=matrix_with(None)), "an entry of transform_matrix is null"),
    "sheared pose": (
        edit_frame(transform_matrix=matrix_with(0.04, row=0, column=1)),
        "frame 1 (images/r_1.png): the rotation of transform_matrix is off orthonormal by 0.04, "
        "expected a rigid transform",
    ),
    "mirrored pose": (edit_frame(transform_matrix=turned(mirror=True)), "is a mirror image"),
    "projective pose": (
        edit_frame(transform_matrix=matrix_with(0.5, row=3, column=0)),
        "the last row of transform_matrix is [0.5, 0.0, 0.0, 1.0], expected [0, 0, 0, 1]",
    ),
    "no focal length": (
        edit_file(fl_x=None, fl_y=None),
        "no focal length, expected fl_x (pixels) or camera_angle_x (radians)",
    ),
    "focal length zero": (
        edit_file(fl_x=0),
        "frame 0 (images/r_0.png): fl_x is 0, expected a positive number",
    ),
    "focal length negative": (edit_file(fl_y=-3), "fl_y is -3, expected a positive number of pixels"),
    "focal length text": (edit_file(fl_x="500"), 'fl_x is "500", expected a finite number'),
    "focal length true": (edit_file(fl_x=True), "fl_x is true, expected a finite number"),
    "focal length huge": (edit_file(fl_x=10**400), "fl_x is 1000000"),
    "angle too wide": (
        edit_frame(camera_angle_x=180.0),
        "camera_angle_x is 180, expected radians between 0 and pi",
    ),
    "size of none": (edit_file(w=0), "w is 0, expected a positive whole number of pixels"),
    "size broken": (edit_file(h=7.5), "h is 7.5, expected a positive whole number of pixels"),
    "fisheye": (
        edit_file(camera_model="FISHEYE624"),
        "camera_model is FISHEYE624, expected one of PINHOLE, SIMPLE_PINHOLE, OPENCV",
    ),
    "fisheye flag": (edit_file(is_fisheye=True, cx=-5), "maps no ray to a side of its image"),
    "fisheye flag as a number": (edit_file(is_fisheye=1, cx=-5), "maps no ray to a side of its image"),
    "far principal point": (
        edit_frame(cx=1e308),
        "frame 1 (images/r_1.png): principal point cx is 1e+308, expected pixels near the image",
    ),
    "focal length tiny": (edit_frame(fl_x=1e-308), "frame 1 (images/r_1.png): focal length fx is 1e-308"),
    "huge lens": (edit_frame(k1=1e308), "expected coefficients of a real lens"),
    "model a number": (edit_frame(camera_model=4), "camera_model is 4, expected text"),
    "k4": (edit_file(k4=0.1), "k4 is not 0, expected no distortion beyond k1 k2 p1 p2 k3"),
    "k1 text": (edit_file(k1="a"), 'k1 is "a", expected a finite number'),
    "unit of depth": (
        edit_file(depth_unit_scale_factor=0),
        "depth_unit_scale_factor is 0, expected a positive",
    ),
    "list of a split": (
        edit_file(train_filenames=["images/nix.png"]),
        "train_filenames lists 'images/nix.png', expected the file_path of one of its 6 frames",
    ),
    "size": (edit_file(w=13), "frame 1 (images/r_1.png): r_1.png is 12x8, expected 13x8 as w and h say"),
}


@pytest.mark.parametrize("case", BAD_DESCRIPTIONS)
def test_bad_descriptions(nerfstudio: Callable[..., Path], case: str) -> None:
    edit, expected = BAD_DESCRIPTIONS[case]
    text = message(nerfstudio(edit))
    assert expected in text
    assert "transforms.json" in text


def test_images_of_different_size(nerfstudio: Callable[..., Path]) -> None:
    folder = nerfstudio(edit_file(w=None, h=None))
    iio.imwrite(folder / "images/r_2.png", np.zeros((H + 1, W, 3), dtype=np.uint8))
    text = message(folder)
    assert "frame 2 (images/r_2.png): r_2.png is 12x9, expected 12x8 as r_1.png is" in text


def test_depth_of_another_aspect_ratio(nerfstudio: Callable[..., Path]) -> None:
    folder = nerfstudio()
    write_depth(folder, ["depth/r_0.png"], (H, W // 2))
    assert "depth/r_0.png: depth is 6x8, but its image is 12x8; expected the same aspect ratio" in message(
        folder
    )


def test_an_image_of_another_size_is_not_decoded(nerfstudio: Callable[..., Path]) -> None:
    """Its size is in the header: the pixels of this one are damaged, and nobody notices."""
    folder = nerfstudio()
    iio.imwrite(folder / "images/r_2.png", np.zeros((500, 400, 3), dtype=np.uint8))
    damaged(folder / "images/r_2.png", "cut")
    assert "r_2.png is 400x500, expected 12x8 as w and h say" in message(folder)


def test_pipes_are_refused_or_left_out_and_do_not_hang(nerfstudio: Callable[..., Path]) -> None:
    folder = nerfstudio()
    for name in ("images/r_2.png", "depth/r_3.png"):
        (folder / name).unlink()
        os.mkfifo(folder / name)
    with pytest.warns(InputWarning, match="missing and left out"):
        assert len(read_all(folder)) == 5
    (folder / "transforms.json").unlink()
    os.mkfifo(folder / "transforms.json")
    message(folder)


def damaged(path: Path, how: str) -> None:
    content = path.read_bytes()
    path.write_bytes({"cut": content[: len(content) // 2], "empty": b"", "text": b"no image at all"}[how])


@pytest.mark.parametrize("how", ["cut", "empty", "text"])
@pytest.mark.parametrize("what", ["images/r_3.png", "depth/r_3.png"])
def test_damaged_files(nerfstudio: Callable[..., Path], what: str, how: str) -> None:
    folder = nerfstudio()
    damaged(folder / what, how)
    text = message(folder)
    assert text.startswith(f"{folder / what}: not readable as an image (")
    assert "BufferedReader" not in text
    assert ("the file is empty" in text) == (how == "empty")
    assert ("none of the formats PNG" in text) == (how == "text")


def test_damaged_jpeg_and_array(nerfstudio: Callable[..., Path]) -> None:
    folder = nerfstudio(edit_frame(0, file_path="images/a.jpg", depth_file_path="depth/a.npy"))
    iio.imwrite(folder / "images/a.jpg", pixels(0, 3))
    (folder / "depth/a.npy").write_bytes(b"no array")
    text = message(folder)
    assert text.startswith(f"{folder / 'depth/a.npy'}: not readable as an array (")
    damaged(folder / "images/a.jpg", "cut")
    assert f"{folder / 'images/a.jpg'}: not readable as an image (" in message(folder)


def test_odd_pixels(nerfstudio: Callable[..., Path]) -> None:
    folder = nerfstudio(edit_frame(0, file_path="images/a.tif"))
    Image.fromarray(np.zeros((H, W), dtype=np.float32)).save(folder / "images/a.tif")
    assert f"{folder / 'images/a.tif'}: image decodes to 8x12 of float32, expected grey, RGB" in message(
        folder
    )
    folder = nerfstudio()
    iio.imwrite(folder / "depth/r_0.png", np.zeros((H, W, 3), dtype=np.uint8))
    assert f"{folder / 'depth/r_0.png'}: depth is 8x12x3 of uint8, expected one channel" in message(folder)


def test_cmyk_becomes_rgb_and_is_not_taken_for_alpha(nerfstudio: Callable[..., Path]) -> None:
    folder = nerfstudio(edit_frame(0, file_path="images/a.jpg"))
    Image.new("CMYK", (W, H), (0, 255, 0, 0)).save(folder / "images/a.jpg")
    frames = {view.frame.name: view.frame for view in read_all(folder)}
    assert frames["a"].alpha is None
    torch.testing.assert_close(
        frames["a"].rgb, torch.tensor([1.0, 0.0, 1.0]).expand(H, W, 3), atol=0.02, rtol=0
    )


def test_background_is_known_though_the_first_image_is_missing(blender: Path) -> None:
    (blender / "train/r_0.png").unlink()
    with pytest.warns(InputWarning, match="1 of 6 images is missing"):
        assert open_dataset(blender).background == (1, 1, 1)


@pytest.mark.data
@pytest.mark.parametrize("scene", ["blender_lego", "tum_fr1_xyz", "room_living"])
def test_recorded_scenes_open(data_dir: Path, scene: str) -> None:
    dataset = open_dataset(data_dir / scene)
    assert dataset.splits == ("train", "test")
    for split in dataset.splits:
        name = dataset.frame_names(split)[-1]
        view = dataset.views(split, [name])[0]
        assert view.frame.name == name
        assert view.T_ref_camera.is_rigid(1e-9)
        assert view.frame.has_depth or scene == "blender_lego"
    assert dataset.background == ((1, 1, 1) if scene == "blender_lego" else (0, 0, 0))
