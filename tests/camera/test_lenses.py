"""Lenses that are no pinhole cameras: projection, undistortion on reading, panoramas, and the readers that meet them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import torch
from PIL import Image

from bidnerf_core.camera import (
    MODELS,
    PANORAMA_FACES,
    CentralLens,
    Intrinsics,
    Lens,
    Orientation,
    PanoramaFace,
    colmap_camera,
)

# Inside: each lens model is compared with COLMAP's and OpenCV's own projection
from bidnerf_core.datasets import open_dataset, open_sequence
from bidnerf_core.errors import InputWarning
from bidnerf_core.frames import Frame
from bidnerf_core.geometry import SE3
from optional import require
from photo_files import write_photo
from refusals import refused
from scan_layouts import edit_frame, edit_keys, small_views, write_image, write_nerfstudio

PARAMETERS = {
    "OPENCV_FISHEYE": [60.0, 62.0, 100.0, 76.0, 0.02, -0.01, 0.003, -0.001],
    "SIMPLE_RADIAL_FISHEYE": [60.0, 100.0, 80.0, 0.03],
    "RADIAL_FISHEYE": [60.0, 100.0, 80.0, 0.03, -0.01],
    "SIMPLE_FISHEYE": [60.0, 100.0, 80.0],
    "FISHEYE": [60.0, 62.0, 100.0, 80.0],
    "SIMPLE_DIVISION": [120.0, 100.0, 80.0, -0.2],
    "DIVISION": [120.0, 122.0, 100.0, 80.0, -0.1],
}
SIZE = (200, 160)


def lens_of(model: str) -> Lens:
    return colmap_camera("test", model, *SIZE, PARAMETERS[model])


def scene(rays: np.ndarray) -> np.ndarray:
    """The colour (0 to 255) of a smooth world at infinity, of rays (... 3) with OpenCV axes."""
    x, y, z = np.moveaxis(rays / np.linalg.norm(rays, axis=-1, keepdims=True), -1, 0)
    return np.stack([127 + 100 * np.sin(3 * x), 127 + 100 * np.sin(4 * y), 127 + 100 * z], axis=-1)


def photo_of(lens: Lens) -> np.ndarray:
    """The image that the lens takes of the scene, by pycolmap's inverse of its projection."""
    assert isinstance(lens, CentralLens)
    camera = pycolmap.Camera(model=lens.model, width=SIZE[0], height=SIZE[1], params=PARAMETERS[lens.model])
    v, u = np.mgrid[: SIZE[1], : SIZE[0]] + 0.5
    flat = np.asarray(camera.cam_ray_from_img(np.stack([u, v], -1).reshape(-1, 2)))
    return np.nan_to_num(scene(flat.reshape(SIZE[1], SIZE[0], 3)).round()).astype(np.uint8)


def panorama(width: int) -> np.ndarray:
    v, u = np.mgrid[: width // 2, :width] + 0.5
    longitude, latitude = (u / width - 0.5) * 2 * np.pi, (0.5 - 2 * v / width) * np.pi
    rays = np.stack([np.sin(longitude) * np.cos(latitude), -np.sin(latitude), np.cos(longitude) * np.cos(latitude)], -1)
    return scene(rays).round().astype(np.uint8)


def error_of(frame: Frame, rotation: np.ndarray | None = None) -> float:
    """The largest difference (of 255) between a frame and the scene, over pixels that are not hidden."""
    rays = frame.intrinsics.unproject(frame.intrinsics.pixel_centres(torch.float64)).numpy()
    expected = scene(rays if rotation is None else rays @ rotation.T)
    wrong = np.abs(frame.rgb.numpy() * 255 - expected).max(-1)
    return float(wrong[~frame.hidden.numpy()].max() if frame.hidden is not None else wrong.max())


@pytest.mark.parametrize("model", PARAMETERS)
def test_projection_is_colmaps(model: str) -> None:
    points = np.random.default_rng(0).uniform(-1.2, 1.2, (200, 2))
    camera = pycolmap.Camera(model=model, width=SIZE[0], height=SIZE[1], params=PARAMETERS[model])
    expected = np.asarray(camera.img_from_cam(np.concatenate([points, np.ones((200, 1))], axis=1)))
    assert np.nanmax(np.abs(lens_of(model).project(points) - expected)) < 1e-9
    assert model in MODELS
    assert colmap_camera("test", model, *SIZE, PARAMETERS[model]) == lens_of(model)


@pytest.mark.parametrize("model", PARAMETERS)
def test_an_undistorted_image_is_that_of_its_pinhole_camera(model: str) -> None:
    lens = lens_of(model)

    depth = torch.ones(SIZE[1], SIZE[0])
    frame = Frame.taken("f", lens, torch.from_numpy(photo_of(lens)), depth, depth)
    assert error_of(frame) < 4
    assert frame.camera_source == lens.sentence
    assert f"{model} undistorted to a pinhole camera of {frame.intrinsics.width}x" in lens.sentence
    assert frame.depth is not None
    seen = frame.depth if frame.hidden is None else frame.depth[~frame.hidden]
    assert bool((seen == 1).all())


@pytest.mark.parametrize("code", range(1, 9))
def test_turned_photos_are_undistorted_alike(code: int) -> None:
    """Undistorting the upright image is turning the undistorted one."""
    lens, orientation = lens_of("OPENCV_FISHEYE"), Orientation.from_exif(code)
    image = torch.from_numpy(photo_of(lens))
    upright = lens.upright(orientation)
    expected = orientation.upright(torch.from_numpy(lens.resample(image.numpy())))
    found = torch.from_numpy(upright.resample(orientation.upright(image).contiguous().numpy()))
    assert found.shape == expected.shape == (upright.pinhole.height, upright.pinhole.width, 3)
    assert int((found.int() - expected.int()).abs().max()) <= 1
    assert upright.pinhole == lens.pinhole.upright(orientation)
    half = upright.resized(upright.width // 2, upright.height // 2)
    assert half.pinhole.fx == pytest.approx(upright.pinhole.fx / 2)


def test_a_photo_is_undistorted_by_the_camera_that_is_given(tmp_path: Path) -> None:
    lens = lens_of("OPENCV_FISHEYE")
    path = write_photo(tmp_path / "a.png", photo_of(lens))
    row = f"1 OPENCV_FISHEYE {SIZE[0]} {SIZE[1]} {' '.join(map(str, PARAMETERS['OPENCV_FISHEYE']))}\n"
    (tmp_path / "cameras.txt").write_text(row)
    frame = Frame.open(path, camera=tmp_path / "cameras.txt")
    assert frame.intrinsics == lens.pinhole
    assert error_of(frame) < 4
    assert "OPENCV_FISHEYE undistorted to a pinhole" in require(frame.camera_source)
    small = Frame.open(path, camera=tmp_path / "cameras.txt", largest=100)
    assert small.intrinsics == lens.resized(100, 80).pinhole
    assert error_of(small) < 8
    (timed,) = open_sequence(tmp_path, camera=tmp_path / "cameras.txt")
    assert torch.equal(timed.frame.rgb, frame.rgb)


def write_fisheye(folder: Path, **changes: object) -> Path:
    """A dataset of two images, of which the second has twice the size that the camera is given for."""
    lens, names = lens_of("OPENCV_FISHEYE"), ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "k3", "k4")
    file = write_nerfstudio(folder, small_views(2)) / "transforms.json"
    keys = {"camera_model": "OPENCV_FISHEYE", "w": SIZE[0], "h": SIZE[1]}
    edit_keys(file, **keys | dict(zip(names, PARAMETERS["OPENCV_FISHEYE"], strict=True)) | changes)
    for number in range(2):
        write_image(folder / f"{number}.png", photo_of(lens))
        mask = "mask.png" if number else None
        edit_frame(file, number, file_path=f"{number}.png", depth_file_path=None, mask_path=mask)
    write_image(folder / "mask.png", np.repeat(np.uint8([[0, 255]]), 100, 1).repeat(SIZE[1], 0))
    return folder


@pytest.mark.parametrize("in_folder", [False, True])
@pytest.mark.parametrize("changes", [{}, {"camera_model": None, "is_fisheye": True}])
def test_fisheye_in_transforms_has_masks_of_the_images_as_stored(
    changes: dict[str, object], in_folder: bool, tmp_path: Path
) -> None:
    folder, masks = write_fisheye(tmp_path, **changes), tmp_path / "masks"
    masks.mkdir()
    (masks / "1.png").write_bytes((folder / "mask.png").read_bytes())
    dataset = open_dataset(folder, masks=masks if in_folder else None)
    (first,), (second,) = dataset.views("test"), dataset.views("train")
    assert first.frame.intrinsics == lens_of("OPENCV_FISHEYE").pinhole
    assert error_of(first.frame) < 4
    hidden, middle = second.frame.hidden, int(first.frame.intrinsics.cx)
    assert hidden is not None
    assert bool(hidden[:, : middle - 2].all())
    assert not bool(hidden[40:-40, middle + 2 : -40].any())
    assert second.frame.rgb_bytes.dtype == torch.uint8


@pytest.mark.parametrize(("size", "factor"), [((400, 320), 2), ((100, 80), 0.5)])
def test_cameras_are_scaled_to_images_that_were_resized(size: tuple[int, int], factor: float, tmp_path: Path) -> None:
    folder = write_fisheye(tmp_path, camera_model="PINHOLE", k1=None, k2=None, k3=None, k4=None)
    for number in range(2):
        with Image.open(folder / f"{number}.png") as image:
            image.resize(size).save(folder / f"{number}.png")
    with pytest.warns(
        InputWarning, match=r"0\.png is \d+x\d+, but w and h are 200x160; cameras are scaled to the images"
    ):
        (view,) = open_dataset(folder).views("test")
    expected = Intrinsics(60 * factor, 62 * factor, 100 * factor, 76 * factor, *size)
    assert view.frame.intrinsics == expected
    Image.fromarray(np.zeros((100, 100, 3), np.uint8)).save(folder / "0.png")
    with refused(where=folder / "0.png", found="image is 100x100, but its camera is for 200x160"):
        open_dataset(folder).views("test")


def test_a_panorama_becomes_six_views_that_show_the_world_around(tmp_path: Path) -> None:
    Image.fromarray(panorama(720)).save(tmp_path / "p.png")
    T = SE3.exp(torch.tensor([0.3, -0.2, 0.1, 0.4, -0.7, 0.2], dtype=torch.float64))
    opengl = (T.matrix() * torch.tensor([1.0, -1.0, -1.0, 1.0])).tolist()
    frame = {"file_path": "p.png", "transform_matrix": opengl}
    content = {"camera_model": "EQUIRECTANGULAR", "w": 720, "h": 360, "frames": [frame]}
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    dataset = open_dataset(tmp_path)
    assert dataset.frame_names("train") == [f"p_{face}" for face in PANORAMA_FACES]
    for view in dataset.views("train"):
        torch.testing.assert_close(view.T_ref_camera.translation, T.translation)
        turn = (T.inverse() @ view.T_ref_camera).rotation.numpy()
        assert error_of(view.frame, turn) < 3
        assert view.frame.hidden is None
    ahead = dataset.views("train", ["p_front", "p_up", "p_right"])
    axes = [(T.inverse() @ view.T_ref_camera).rotation[:, 2].round().tolist() for view in ahead]
    assert axes == [[0, 0, 1], [0, -1, 0], [1, 0, 0]]
    frame["depth_file_path"] = "d.png"
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    with refused(where="frame 0 (p.png)", found="equirectangular image has depth", expected="none"):
        open_dataset(tmp_path)


def test_lenses_and_panoramas_in_models_of_colmap(tmp_path: Path) -> None:
    lens = lens_of("SIMPLE_RADIAL_FISHEYE")
    (tmp_path / "images").mkdir()
    Image.fromarray(photo_of(lens)).save(tmp_path / "images/a.png")
    Image.fromarray(panorama(240)).save(tmp_path / "images/b.png")
    model = pycolmap.Reconstruction()
    for number, (name, size, kind) in enumerate([("a.png", SIZE, lens), ("b.png", (240, 120), None)], start=1):
        parameters = PARAMETERS["SIMPLE_RADIAL_FISHEYE"] if kind else [240.0, 120.0]
        title = "SIMPLE_RADIAL_FISHEYE" if kind else "EQUIRECTANGULAR"
        camera = pycolmap.Camera(model=title, width=size[0], height=size[1], params=parameters, camera_id=number)
        model.add_camera_with_trivial_rig(camera)
        image = pycolmap.Image(name=name, camera_id=number, image_id=number)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
    for write in (model.write_text, model.write_binary):
        sparse = tmp_path / "sparse/0"
        sparse.mkdir(parents=True, exist_ok=True)
        for file in sparse.iterdir():
            file.unlink()
        write(sparse)
        dataset = open_dataset(tmp_path)
        views = [view for split in ("test", "train") for view in dataset.views(split)]
        assert views[0].frame.intrinsics == lens.pinhole
        assert error_of(views[0].frame) < 4
        assert [view.frame.name for view in views[1:]] == [f"b_{face}" for face in PANORAMA_FACES]


@pytest.mark.parametrize(
    ("model", "parameters", "found", "expected"),
    [
        ("OPENCV_FISHEYE", [1.0, 2.0, 3.0], "OPENCV_FISHEYE has 3 parameters", 8),
        ("OPENCV_FISHEYE", [60.0, 60.0, 300.0, 80.0, 0, 0, 0, 0], "maps no ray to a side", "a real lens"),
        ("SIMPLE_DIVISION", [60.0, 100.0, 80.0, float("nan")], "nan", "a real lens"),
        ("EQUIRECTANGULAR", [200.0, 160.0], "200x160", "twice as many columns as rows"),
    ],
)
def test_what_is_no_lens_is_refused(model: str, parameters: list[float], found: str, expected: object) -> None:
    with refused(where="here", found=found, expected=expected):
        colmap_camera("here", model, *SIZE, parameters)


def test_a_panorama_cannot_be_rotated() -> None:
    with refused(found="cannot be rotated", expected="an upright one"):
        PanoramaFace("front", (20, 10)).upright(Orientation.from_exif(6))
