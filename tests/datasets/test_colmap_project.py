"""COLMAP projects: text and binary models, pycolmap as the oracle, the same photos through ``transforms.json``."""

from __future__ import annotations

import shutil
import struct
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pycolmap
import pytest
import torch
from scipy.spatial.transform import Rotation

from bidnerf_core.camera import Intrinsics
from bidnerf_core.datasets import open_dataset, open_sequence
from bidnerf_core.errors import InputError
from bidnerf_core.frames import View
from bidnerf_core.geometry import SE3

CAMERAS = {
    1: "1 PINHOLE 16 12 20 21 8.5 6.25",
    2: "2 SIMPLE_RADIAL 16 12 19 8 6 0.05",
    5: "5 OPENCV 16 12 20 20 8 6 0.1 -0.02 0.001 0.002",
}
EXPECTED = {
    1: Intrinsics(20, 21, 8.5, 6.25, 16, 12),
    2: Intrinsics(19, 19, 8, 6, 16, 12, (0.05, 0, 0, 0)),
    5: Intrinsics(20, 20, 8, 6, 16, 12, (0.1, -0.02, 0.001, 0.002)),
}
NAMES = [f"left/{n}.png" for n in (10, 2, 1)] + [f"right/{n}.png" for n in (1, 2, 3, 4, 5, 6, 7)]
IN_ORDER = ["left/1.png", "left/2.png", "left/10.png", *(f"right/{n}.png" for n in range(1, 8))]
Posed = tuple[str, int, SE3]  # name, camera, T_world_camera


def write_model(folder: Path, cameras: Sequence[str], posed: Sequence[Posed]) -> Path:
    """Write ``cameras.txt``, ``images.txt`` and ``points3D.txt`` as COLMAP's documentation has them."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "cameras.txt").write_text(
        "# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n" + "\n".join(cameras) + "\n"
    )
    rows = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n"]
    for number, (name, camera, T_world_camera) in enumerate(posed, start=1):
        T = T_world_camera.inverse()
        x, y, z, w = Rotation.from_matrix(T.rotation.numpy()).as_quat()
        pose = " ".join(repr(float(value)) for value in (w, x, y, z, *T.translation))
        rows.append(f"{number} {pose} {camera} {name}\n1.5 2.5 -1\n")
    (folder / "images.txt").write_text("".join(rows))
    (folder / "points3D.txt").write_text("# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[]\n")
    return folder


def poses() -> list[SE3]:
    generator = torch.Generator().manual_seed(3)
    return [SE3.exp(torch.randn(6, generator=generator, dtype=torch.float64)) for _ in NAMES]


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """Ten images of three cameras in two folders, listed out of order."""
    folder = tmp_path / "project"
    for number, name in enumerate(NAMES):
        (folder / "images" / name).parent.mkdir(parents=True, exist_ok=True)
        iio.imwrite(folder / "images" / name, np.full((12, 16, 3), 10 * number, np.uint8))
    cameras = [*CAMERAS][:2] * 4 + [5, 5]
    write_model(
        folder / "sparse" / "0", list(CAMERAS.values()), list(zip(NAMES, cameras, poses(), strict=True))
    )
    return folder


def to_binary(project: Path) -> None:
    model = project / "sparse" / "0"
    pycolmap.Reconstruction(str(model)).write_binary(str(model))
    for file in model.glob("*.txt"):
        file.unlink()


def all_views(folder: Path) -> dict[str, View]:
    dataset = open_dataset(folder)
    return {view.frame.name: view for split in dataset.splits for view in dataset.views(split)}


@pytest.mark.parametrize("binary", [False, True])
def test_poses_and_cameras_are_those_of_the_model(binary: bool, project: Path) -> None:
    if binary:
        to_binary(project)
    cameras = [*CAMERAS][:2] * 4 + [5, 5]
    for timed, name in zip(open_sequence(project), IN_ORDER, strict=True):
        number = NAMES.index(name)
        assert timed.frame.intrinsics == EXPECTED[cameras[number]]
        assert float(timed.frame.rgb.mean()) == pytest.approx(10 * number / 255)
        assert timed.truth is not None
        torch.testing.assert_close(timed.truth.matrix(), poses()[number].matrix(), atol=1e-9, rtol=0)


def test_every_eighth_is_held_out_in_natural_order(project: Path) -> None:
    dataset = open_dataset(project)
    assert dataset.frame_names("test") == ["1", "6"]
    assert len(dataset.frame_names("train")) == 8
    assert [timed.split for timed in open_sequence(project)] == ["test", *["train"] * 7, "test", "train"]


def test_projection_agrees_with_pycolmap(project: Path) -> None:
    model = pycolmap.Reconstruction(str(project / "sparse" / "0"))
    views = list(open_sequence(project))
    by_name = {image.name: image for image in model.images.values()}
    for timed, name in zip(views, IN_ORDER, strict=True):
        image = by_name[name]
        point = np.array([0.1, -0.05, 2.0])
        expected = image.camera.img_from_cam(point)
        found = timed.frame.intrinsics.project(torch.from_numpy(point))
        np.testing.assert_allclose(found, expected, atol=1e-9)
        assert timed.truth is not None
        world = image.cam_from_world().inverse() * point
        np.testing.assert_allclose(timed.truth.apply(torch.from_numpy(point)), world, atol=1e-9)


PLACES = {  # of the model and of the images
    "sparse": "images", "colmap/sparse/0": "images", "colmap": "colmap/images", ".": ".", "dense/0/sparse": "dense/0/images",
    "sparse/0": "input", "dense/sparse": "dense/images",
}  # fmt: skip


@pytest.mark.parametrize("place", PLACES)
def test_models_and_images_at_other_places(place: str, project: Path) -> None:
    expected = all_views(project)
    images, model = project / "moved images", project / "moved model"
    (project / "images").rename(images)
    (project / "sparse" / "0").rename(model)
    shutil.rmtree(project / "sparse")
    for source, target in ((model, project / place), (images, project / PLACES[place])):
        target.mkdir(parents=True, exist_ok=True)
        for file in list(source.iterdir()):
            file.rename(target / file.name)
        source.rmdir()
    assert all_views(project).keys() == expected.keys()


def test_the_folder_of_a_model_finds_its_images(project: Path) -> None:
    assert all_views(project / "sparse").keys() == all_views(project).keys()
    assert all_views(project / "sparse" / "0").keys() == all_views(project).keys()


def remarks_of(folder: Path) -> list[str]:
    """Return the remarks that opening a folder causes."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        open_dataset(folder)
    return [str(warning.message) for warning in caught]


@pytest.mark.parametrize("binary", [False, True])
def test_the_largest_of_several_models_is_used(binary: bool, project: Path) -> None:
    """The first model of the mapper has two of the ten images."""
    (project / "sparse" / "0").rename(project / "sparse" / "1")
    write_model(project / "sparse" / "0", [CAMERAS[1]], [(name, 1, SE3.identity()) for name in NAMES[:2]])
    if binary:
        for model in (project / "sparse").iterdir():
            pycolmap.Reconstruction(str(model)).write_binary(str(model))
            for file in model.glob("*.txt"):
                file.unlink()
    (said,) = remarks_of(project)
    assert "has 2 models, of which sparse/1 with 10 images is used, not sparse/0 (2)" in said
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert len(open_sequence(project)) == 10


def test_missing_images_and_photos_that_are_not_registered_are_counted(project: Path) -> None:
    (project / "images/left/2.png").rename(project / "images/left/99.png")
    said = remarks_of(project)
    assert any("images: 1 of 10 images is missing and left out, first: left/2.png" in text for text in said)
    assert any(
        "1 of 10 photos are not registered in the model and are left out, first: left/99.png" in text
        for text in said
    )
    assert len(said) == 2
    shutil.rmtree(project / "images")
    with pytest.raises(InputError, match=r"images/.*/\d+\.png: no such file, although .* lists that image"):
        open_dataset(project)


def test_names_of_windows(project: Path) -> None:
    expected = all_views(project)
    model = project / "sparse" / "0" / "images.txt"
    model.write_text(model.read_text().replace("left/", "left\\").replace("right/", "Right\\"))
    assert all_views(project).keys() == {name.replace("right", "Right") for name in expected}


def test_rigs_and_frames_of_newer_versions_are_harmless(project: Path) -> None:
    expected = all_views(project)
    to_binary(project)
    assert (project / "sparse/0/rigs.bin").is_file()
    assert (project / "sparse/0/frames.bin").is_file()
    for name, view in all_views(project).items():
        torch.testing.assert_close(
            view.T_ref_camera.matrix(), expected[name].T_ref_camera.matrix(), atol=1e-9, rtol=0
        )


def test_depth_maps_of_a_dense_reconstruction(project: Path) -> None:
    """They are those of the images, in units of the model, and the geometric ones are preferred."""
    maps = project / "stereo/depth_maps"
    for name, kind, value in (
        ("left/1", "photometric", 3.0),
        ("left/1", "geometric", 2.0),
        ("right/7", "photometric", 4.0),
    ):
        (maps / name).parent.mkdir(parents=True, exist_ok=True)
        depth = np.full((12, 16), value, np.float32) + np.arange(16, dtype=np.float32) / 10
        depth[0] = 0
        (maps / f"{name}.png.{kind}.bin").write_bytes(b"16&12&1&" + depth.tobytes())
    views = all_views(project)
    measured = {name: view.frame.depth for name, view in views.items() if view.frame.depth is not None}
    assert {name: round(float(depth[5, 0]), 3) for name, depth in measured.items()} == {
        "1": 2,
        "7": 4,
    }
    assert all(float(depth[0].abs().max()) == 0 for depth in measured.values())
    assert float(measured["1"][7, 15]) == pytest.approx(3.5)
    file = maps / "left/1.png.geometric.bin"
    for content, message in (
        (file.read_bytes()[:-4], "has 764 bytes after 16&12&1&, expected 768"),
        (b"PNG", "does not begin with"),
    ):
        file.write_bytes(content)
        with pytest.raises(InputError, match=message):
            all_views(project)


def test_images_reduced_after_the_reconstruction(project: Path) -> None:
    for name in NAMES:
        iio.imwrite(project / "images" / name, np.zeros((6, 8, 3), np.uint8))
    for timed in open_sequence(project):
        assert (timed.frame.intrinsics.width, timed.frame.intrinsics.height) == (8, 6)
        assert timed.frame.intrinsics.fx in (10.0, 9.5)


@pytest.mark.data
@pytest.mark.parametrize("binary", [False, True])
def test_recorded_photos_are_those_of_transforms_json(binary: bool, data_dir: Path, tmp_path: Path) -> None:
    dataset = open_dataset(data_dir / "phone_doll")
    expected = dataset.views("train")[:12]
    shutil.copytree(data_dir / "phone_doll" / "images", tmp_path / "images")
    camera = expected[0].frame.intrinsics
    k1, *others = camera.distortion
    assert not any(others)
    row = f"1 RADIAL {camera.width} {camera.height} {camera.fx!r} {camera.cx!r} {camera.cy!r} {k1!r} 0"
    posed = [(f"{view.frame.name}.jpg", 1, view.T_ref_camera) for view in expected]
    write_model(tmp_path / "sparse" / "0", [row], posed)
    if binary:
        to_binary(tmp_path)
    for timed, view in zip(open_sequence(tmp_path), expected, strict=True):
        assert timed.frame.name == view.frame.name
        assert timed.frame.intrinsics == view.frame.intrinsics
        assert torch.equal(timed.frame.rgb, view.frame.rgb)
        assert timed.truth is not None
        torch.testing.assert_close(timed.truth.matrix(), view.T_ref_camera.matrix(), atol=1e-9, rtol=0)


def replaced(name: str, old: str, new: str) -> Callable[[Path], None]:
    def change(model: Path) -> None:
        text = (model / name).read_text()
        assert old in text
        (model / name).write_text(text.replace(old, new, 1))

    return change


BROKEN: dict[str, tuple[Callable[[Path], None], str]] = {
    "fisheye": (
        replaced("cameras.txt", "5 OPENCV 16 12 20 20 8 6 0.1 -0.02 0.001 0.002", "5 THIN_PRISM_FISHEYE 16 12 20 20 8 6 0 0 0 0"),
        r"cameras\.txt: line 4: camera model THIN_PRISM_FISHEYE, expected one of",
    ),
    "parameters": (replaced("cameras.txt", "8.5 6.25", "8.5"), r"cameras\.txt: line 2: PINHOLE has 3 parameters, expected 4"),
    "camera twice": (replaced("cameras.txt", "2 SIMPLE", "1 SIMPLE"), r"cameras\.txt: line 3: camera 1 is repeated"),
    "no camera": (replaced("cameras.txt", "5 OPENCV", "6 OPENCV"), r"image 'right/6\.png' has the camera 5, which is missing from cameras"),
    "image twice": (replaced("images.txt", "left/2.png", "left/1.png"), r"image left/1\.png is registered twice"),
    "empty": (lambda model: (model / "images.txt").write_text("# nothing\n") and None, r"has no registered image"),
}  # fmt: skip


@pytest.mark.parametrize("case", BROKEN)
def test_broken_models_are_named(case: str, project: Path) -> None:
    change, message = BROKEN[case]
    change(project / "sparse" / "0")
    with pytest.raises(InputError, match=message) as caught:
        list(open_sequence(project))
    assert "\n" not in str(caught.value)


def test_every_truncation_of_a_binary_model_is_refused(project: Path) -> None:
    to_binary(project)
    for name in ("cameras.bin", "images.bin"):
        file = project / "sparse" / "0" / name
        whole = file.read_bytes()
        for length in {*range(24), *range(0, len(whole), 97), len(whole) - 1}:
            file.write_bytes(whole[:length])
            with pytest.raises(InputError, match=name):
                open_dataset(project)
        file.write_bytes(whole)


def test_a_binary_camera_that_is_not_perspective(project: Path) -> None:
    to_binary(project)
    file = project / "sparse" / "0" / "cameras.bin"
    content = bytearray(file.read_bytes())
    struct.pack_into("<i", content, 12, 10)  # the model of the first camera: THIN_PRISM_FISHEYE
    file.write_bytes(content)
    with pytest.raises(
        InputError, match=r"cameras\.bin: camera \d has the model 10, expected one of SIMPLE_PINHOLE"
    ):
        open_dataset(project)
