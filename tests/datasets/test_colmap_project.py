"""COLMAP projects: text and binary models, with pycolmap as the oracle; what is at other places, missing, or dense."""

from __future__ import annotations

import shutil
import struct
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
import torch

from bidnerf_core.datasets import open_dataset, open_sequence
from bidnerf_core.geometry import SE3
from optional import require
from refusals import refused
from scan_layouts import message, read_all, remarks_of
from sparse_model import to_binary, write_model

pycolmap = pytest.importorskip("pycolmap")

CAMERAS = [
    "1 PINHOLE 16 12 20 21 8.5 6.25",
    "2 SIMPLE_RADIAL 16 12 19 8 6 0.05",
    "5 OPENCV 16 12 20 20 8 6 0.1 -0.02 0.001 0.002",
]
NAMES = [f"left/{n}.png" for n in (10, 2, 1)] + [f"right/{n}.png" for n in (1, 2, 3, 4, 5, 6, 7)]
IN_ORDER = ["left/1.png", "left/2.png", "left/10.png", *(f"right/{n}.png" for n in range(1, 8))]

pytestmark = pytest.mark.filterwarnings("ignore::bidnerf_core.errors.InputWarning")


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """Ten images of three cameras in two folders, listed out of order."""
    folder, generator = tmp_path / "project", torch.Generator().manual_seed(3)
    for number, name in enumerate(NAMES):
        (folder / "images" / name).parent.mkdir(parents=True, exist_ok=True)
        iio.imwrite(folder / "images" / name, np.full((12, 16, 3), 10 * number, np.uint8))
    poses = [SE3.exp(torch.randn(6, generator=generator, dtype=torch.float64)) for _ in NAMES]
    cameras = [1, 2] * 4 + [5, 5]
    write_model(
        folder / "sparse/0",
        CAMERAS,
        [(name, camera, T, "1.5 2.5 -1") for name, camera, T in zip(NAMES, cameras, poses, strict=True)],
    )
    return folder


@pytest.mark.parametrize("binary", [False, True])
def test_poses_and_projections_are_those_of_pycolmap(binary: bool, project: Path) -> None:
    """Versions from 3.12 on also write rigs and frames, which are harmless."""
    model = pycolmap.Reconstruction(str(project / "sparse/0"))
    if binary:
        assert {file.stem for file in to_binary(project / "sparse/0").iterdir()} > {"rigs", "frames"}
    by_name = {image.name: image for image in model.images.values()}
    for timed, name in zip(open_sequence(project), IN_ORDER, strict=True):
        image = by_name[name]
        assert float(timed.frame.rgb.mean()) == pytest.approx(10 * NAMES.index(name) / 255)
        assert (timed.frame.intrinsics.width, timed.frame.intrinsics.height) == (16, 12)
        for point in np.array([[0.1, -0.05, 2.0], [-0.3, 0.2, 1.0]]):
            expected = image.camera.img_from_cam(point)
            found = timed.frame.intrinsics.project(torch.from_numpy(point))
            np.testing.assert_allclose(found, expected, atol=1e-9)
            world = image.cam_from_world().inverse() * point
            np.testing.assert_allclose(require(timed.truth).apply(torch.from_numpy(point)), world, atol=1e-9)


def test_every_eighth_is_held_out_in_natural_order(project: Path) -> None:
    dataset = open_dataset(project)
    assert dataset.frame_names("test") == ["1", "6"]
    assert len(dataset.frame_names("train")) == 8
    assert [timed.split for timed in open_sequence(project)] == ["test", *["train"] * 7, "test", "train"]


def names(folder: Path) -> set[str]:
    """Return the names of the images that were found, of which one is read."""
    dataset = open_dataset(folder)
    assert dataset.views("test", dataset.frame_names("test")[:1])
    return {name for split in dataset.splits for name in dataset.frame_names(split)}


PLACES = {  # of the model and of the images
    "sparse": "images",
    "colmap/sparse/0": "images",
    "colmap": "colmap/images",
    ".": ".",
    "dense/0/sparse": "dense/0/images",
    "sparse/0": "input",
    "dense/sparse": "dense/images",
}


@pytest.mark.parametrize("place", PLACES)
def test_models_and_images_at_other_places(place: str, project: Path) -> None:
    expected = names(project)
    images, model = project / "moved images", project / "moved model"
    (project / "images").rename(images)
    (project / "sparse" / "0").rename(model)
    shutil.rmtree(project / "sparse")
    for source, target in ((model, project / place), (images, project / PLACES[place])):
        target.mkdir(parents=True, exist_ok=True)
        for file in list(source.iterdir()):
            file.rename(target / file.name)
        source.rmdir()
    assert names(project) == expected


def test_the_folder_of_a_model_finds_its_images(project: Path) -> None:
    assert names(project / "sparse") == names(project / "sparse/0") == names(project)


@pytest.mark.parametrize("binary", [False, True])
def test_the_largest_of_several_models_is_used(binary: bool, project: Path) -> None:
    """The first model of the mapper has two of the ten images."""
    (project / "sparse/0").rename(project / "sparse/1")
    two = [(name, 1, SE3.identity(), "1.5 2.5 -1") for name in NAMES[:2]]
    write_model(project / "sparse/0", CAMERAS[:1], two)
    if binary:
        for model in (project / "sparse").iterdir():
            to_binary(model)
    (said,) = remarks_of(project)
    assert "has 2 models, of which sparse/1 with 10 images is used, not sparse/0 with 2 images" in said
    assert len(open_sequence(project)) == 10


def test_a_project_without_images_is_refused(project: Path) -> None:
    shutil.rmtree(project / "images")
    with refused(where=project / "images/left/1.png", found=f"no such image, although {project}"):
        open_dataset(project)


def test_names_of_windows(project: Path) -> None:
    expected = names(project)
    model = project / "sparse/0/images.txt"
    model.write_text(model.read_text().replace("left/", "left\\").replace("right/", "Right\\"))
    assert names(project) == {name.replace("right", "Right") for name in expected}


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
    views = read_all(project)
    measured = {name: view.frame.depth for name, view in views.items() if view.frame.depth is not None}
    assert {name: round(float(depth[5, 0]), 3) for name, depth in measured.items()} == {
        "1": 2,
        "7": 4,
    }
    assert all(float(depth[0].abs().max()) == 0 for depth in measured.values())
    assert float(measured["1"][7, 15]) == pytest.approx(3.5)
    file = maps / "left/1.png.geometric.bin"
    for content, said in ((file.read_bytes()[:-4], "has 764 bytes"), (b"PNG", "does not begin with")):
        file.write_bytes(content)
        assert said in message(project)


def test_images_reduced_after_the_reconstruction(project: Path) -> None:
    for name in NAMES:
        iio.imwrite(project / "images" / name, np.zeros((6, 8, 3), np.uint8))
    for timed in open_sequence(project):
        assert (timed.frame.intrinsics.width, timed.frame.intrinsics.height) == (8, 6)
        assert timed.frame.intrinsics.fx in (10.0, 9.5)


def test_a_binary_camera_that_is_not_perspective(project: Path) -> None:
    file = to_binary(project / "sparse/0") / "cameras.bin"
    content = bytearray(file.read_bytes())
    struct.pack_into("<i", content, 12, 10)  # the model of the first camera: THIN_PRISM_FISHEYE
    file.write_bytes(content)
    with refused(where=file, found="camera 1 has the model 10", expected="SIMPLE_PINHOLE"):
        open_dataset(project)
