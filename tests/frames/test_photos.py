"""A photo of one's own: upright, with its camera and depth, reduced, over a background; and arrays as frames."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image, ImageOps

from bidnerf import Frame, InputWarning, Intrinsics
from bidnerf_core.datasets import open_dataset
from bidnerf_core.frames import photos_in
from optional import require
from photo_files import noise, write_photo
from refusals import refused

WIDTH, HEIGHT = 40, 30
CAMERA = Intrinsics(33.0, 34.0, 19.0, 16.0, WIDTH, HEIGHT, (0.05, -0.01, 0.01, -0.02))
CODES = range(1, 9)


STEPS = np.random.default_rng(1).integers(1, 5000, (HEIGHT, WIDTH)).astype(np.uint16)
"""Depth in millimetres."""


@pytest.fixture
def photo(tmp_path: Path) -> Path:
    return write_photo(tmp_path / "IMG_7.png", noise(HEIGHT, WIDTH), FocalLengthIn35mmFilm=26)


def save_depth(path: Path, steps: np.ndarray) -> Path:
    Image.fromarray(steps).save(path)
    return path


def quiet(path: Path, depth: Path, **given: object) -> Frame:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return Frame.open(path, depth=depth, **given)  # type: ignore[arg-type]


# Orientation.


@pytest.mark.parametrize("code", CODES)
def test_a_point_stays_on_the_same_content(tmp_path: Path, code: int) -> None:
    """Each stored pixel has a direction; turned with the image, it projects onto the same colour and the same depth."""
    pixels = noise(HEIGHT, WIDTH)
    path = write_photo(tmp_path / "a.png", pixels, code)
    frame = quiet(path, save_depth(tmp_path / "d.png", STEPS), camera=CAMERA, depth_unit=0.001)
    with Image.open(path) as stored:
        upright = np.asarray(ImageOps.exif_transpose(stored))
    assert frame.rgb.numpy() == pytest.approx(upright / np.float32(255))
    # Three stored pixels and where their unique colours are in the upright image give the turn.
    corners = [(0, 0), (WIDTH - 1, 0), (0, HEIGHT - 1)]
    found = [np.argwhere((upright == pixels[v, u]).all(-1))[0][::-1] for u, v in corners]
    right, down = (np.sign(found[i] - found[0]).astype(float) for i in (1, 2))
    turn = torch.from_numpy(np.stack([right, down], axis=-1))
    rays = CAMERA.unproject(CAMERA.pixel_centres(torch.float64)).reshape(-1, 3)
    rays[:, :2] = rays[:, :2] @ turn.mT
    column, row = frame.intrinsics.project(rays).floor().long().unbind(-1)
    torch.testing.assert_close(frame.rgb[row, column], torch.from_numpy(pixels.reshape(-1, 3)).float() / 255)
    expected = torch.from_numpy(STEPS.reshape(-1).astype(np.float32)) * 0.001
    torch.testing.assert_close(require(frame.depth)[row, column], expected)


# Reading.


def test_a_photo_with_exif_needs_nothing_else(photo: Path) -> None:
    for given in (photo, str(photo)):
        frame = Frame.open(given)
        assert frame.name == "IMG_7"
        assert require(frame.camera_source).startswith("26 mm equivalent in EXIF: fx 30 px at 40x30 (the principal")
        assert frame.alpha is frame.depth is None
        torch.testing.assert_close(frame.rgb, torch.from_numpy(noise(HEIGHT, WIDTH)).float() / 255)


@pytest.mark.data
def test_photos_of_a_phone_show_what_the_dataset_shows(data_dir: Path) -> None:
    """The photo equals the dataset's copy at an eighth of the size, up to JPEG and the filter."""
    doll = data_dir / "phone_doll"
    photos, others = photos_in(doll / "photos")
    assert (len(photos), others) == (2, [])
    capture = open_dataset(doll)
    for path in photos:
        frame = Frame.open(path, largest=504)
        known = capture.views("test", [frame.name])[0].frame
        assert frame.rgb.shape == known.rgb.shape
        assert float((frame.rgb - known.rgb).abs().mean()) < 0.02
        assert Frame.open(path, camera=doll / "transforms_test.json", largest=504).intrinsics == known.intrinsics


# Depth.


def test_depth_of_another_resolution_takes_the_nearest(photo: Path, tmp_path: Path) -> None:
    steps = STEPS[::2, ::2]
    depth = quiet(photo, save_depth(tmp_path / "d.png", steps), depth_unit=0.001).depth
    expected = np.repeat(np.repeat(steps, 2, 0), 2, 1).astype(np.float32) * 0.001
    torch.testing.assert_close(depth, torch.from_numpy(expected))
    other = save_depth(tmp_path / "e.png", steps[:, 3:])
    with refused(found=f"{other}: depth is 17x15, but its image is 40x30", expected="the same aspect"):
        Frame.open(photo, depth=other, depth_unit=0.001)


def test_the_assumptions_about_depth_are_one_line(photo: Path, tmp_path: Path) -> None:
    steps = np.full((HEIGHT, WIDTH), 1420, dtype=np.uint16)
    steps[0, :5] = 65535
    path = save_depth(tmp_path / "d.png", steps)
    said = (
        rf"{path}: depth_unit is not given, 0\.001 m per step is assumed: median depth 1\.42 m; "
        "treated as not measured: 5 x 65535$"
    )
    with pytest.warns(InputWarning, match=said):
        frame = Frame.open(photo, depth=path)
    assert not require(frame.depth)[0, :5].any()


# Arrays.


def test_files_and_arrays_make_the_same_frame(photo: Path, tmp_path: Path) -> None:
    read = quiet(photo, save_depth(tmp_path / "d.png", STEPS), camera=CAMERA, depth_unit=0.001)
    for rgb, depth in (
        (noise(HEIGHT, WIDTH), STEPS),
        (torch.from_numpy(noise(HEIGHT, WIDTH)), torch.from_numpy(STEPS.astype(np.int32))),
        (noise(HEIGHT, WIDTH) / 255, STEPS),
    ):
        made = Frame.from_numpy(rgb, CAMERA, depth=depth, depth_unit=0.001, name="a")
        torch.testing.assert_close(made.rgb, read.rgb)
        torch.testing.assert_close(made.depth, read.depth)
        assert (made.name, made.intrinsics) == ("a", CAMERA)


def test_arrays_that_do_not_fit_are_refused() -> None:
    rgb, where = noise(HEIGHT, WIDTH), "frame image"
    assert Frame.from_numpy(rgb, CAMERA.scaled(2)).intrinsics.fx == pytest.approx(CAMERA.fx)
    portrait = Intrinsics(33.0, 34.0, 19.0, 16.0, HEIGHT, WIDTH)
    turned = {"depth": np.ones((WIDTH, HEIGHT)), "depth_unit": 1.0}
    wrong: list[tuple[np.ndarray, Intrinsics, dict[str, Any], str | None, str, str | None]] = [
        (rgb, portrait, {}, where, "rgb is 40x30, but its camera expects 30x40", None),
        (rgb, CAMERA, turned, None, "frame image: depth is 30x40, but its image is 40x30", "the same aspect ratio"),
        (rgb.astype(float), CAMERA, {}, None, "rgb has floats from 0 to 255", "[0, 1]"),
        (noise(HEIGHT, WIDTH, 4), CAMERA, {"alpha": rgb[..., 0]}, where, "rgb has an alpha channel", "only one"),
        (rgb, CAMERA, {"alpha": rgb[..., 0].T}, where, "alpha is 40x30x1", "30x40 as rgb"),
    ]
    for image, camera, given, there, found, expected in wrong:
        with refused(where=there, found=found, expected=expected):
            Frame.from_numpy(image, camera, **given)


# Folders.


def test_photos_of_a_folder_in_natural_order(tmp_path: Path) -> None:
    names = ["IMG_10.jpg", "IMG_2.JPG", "img_1.png", "b.heic", "7.jpeg"]
    other = ["notes.txt", ".DS_Store", "._IMG_2.JPG", "IMG_2.depth.png", "video.mp4"]
    for name in (*names, *other):
        (tmp_path / name).touch()
    (tmp_path / "folder.jpg").mkdir()
    photos, others = photos_in(str(tmp_path))
    assert [path.name for path in photos] == ["7.jpeg", "b.heic", "img_1.png", "IMG_2.JPG", "IMG_10.jpg"]
    assert {path.name for path in others} == set(other)


def test_folders_that_are_none(tmp_path: Path, photo: Path) -> None:
    with refused(where=tmp_path / "none", found="no such folder"):
        photos_in(tmp_path / "none")
    with refused(where=photo, found="not a directory", expected="a folder of photos"):
        photos_in(photo)


@pytest.mark.parametrize(("depth", "unit"), [(np.uint16, "0.001"), (np.float32, "1")])
def test_arrays_without_a_unit_are_warned_of(depth: type, unit: str) -> None:
    with pytest.warns(InputWarning, match=f"frame image: depth_unit is not given, {unit} m per step"):
        Frame.from_numpy(noise(HEIGHT, WIDTH), CAMERA, depth=np.ones((HEIGHT, WIDTH), dtype=depth))
