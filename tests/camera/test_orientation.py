"""The eight orientations of EXIF: Pillow is the oracle for images, and cameras follow the pixels."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from PIL import Image, ImageOps
from PIL.ExifTags import Base

from bidnerf_core.camera import UPRIGHT, Intrinsics, Orientation
from refusals import refused

CODES = range(1, 9)
WIDTH, HEIGHT = 9, 6
LENSES = {
    "ideal": (),
    "tangential": (0.1, -0.05, 0.02, -0.03),
    "thin prism": (0.1, -0.05, 0.02, -0.03, 0.01, 0.02, 0.01, -0.01, 0.03, -0.02, 0.01, 0.04),
}


def turned_by_pillow(image: np.ndarray, code: int) -> np.ndarray:
    exif = Image.Exif()
    exif[Base.Orientation] = code
    stored = Image.fromarray(image)
    stored.info["exif"] = exif.tobytes()
    return np.asarray(ImageOps.exif_transpose(stored))


@pytest.mark.parametrize("code", CODES)
@pytest.mark.parametrize("channels", [1, 3])
def test_images_are_turned_as_pillow_turns_them(code: int, channels: int) -> None:
    image = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, channels), dtype=np.uint8).squeeze()
    found = Orientation.from_exif(code).upright(torch.from_numpy(image)).numpy()
    np.testing.assert_array_equal(found, turned_by_pillow(image, code))
    assert Orientation.from_exif(code).upright_size(WIDTH, HEIGHT) == found.shape[1::-1]


def test_codes_that_exif_does_not_define_mean_upright() -> None:
    assert {Orientation.from_exif(code) for code in (0, 1, 9, -1, 65535)} == {UPRIGHT}


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("code", CODES)
def test_a_camera_sees_each_pixel_in_the_same_direction_up_to_the_turn(code: int, lens: str) -> None:
    """The turn of the plane z = 1 is the linear part of what Pillow does to the pixels."""
    stored = Intrinsics(11.0, 12.0, 4.0, 3.4, WIDTH, HEIGHT, LENSES[lens])
    upright = stored.upright(Orientation.from_exif(code))
    pixels = stored.pixel_centres(torch.float64).reshape(-1, 2)
    # Where Pillow puts the centre of each pixel of the stored raster, row by row.
    numbers = turned_by_pillow(np.arange(WIDTH * HEIGHT, dtype=np.uint8).reshape(HEIGHT, WIDTH), code)
    rows, columns = np.divmod(np.argsort(numbers.reshape(-1)), numbers.shape[1])
    there = torch.from_numpy(np.stack([columns, rows], axis=-1) + 0.5)
    turn = torch.linalg.lstsq(pixels - pixels.mean(0), there - there.mean(0)).solution
    torch.testing.assert_close(Orientation.from_exif(code).axes[:2, :2], turn.mT, atol=1e-9, rtol=0)
    expected = stored.unproject(pixels)[:, :2] @ turn
    torch.testing.assert_close(upright.unproject(there)[:, :2], expected, atol=1e-9, rtol=0)
    assert (upright.width, upright.height) == Orientation.from_exif(code).upright_size(WIDTH, HEIGHT)


def test_a_tilted_sensor_cannot_be_transposed() -> None:
    camera = Intrinsics(11.0, 12.0, 4.0, 3.4, WIDTH, HEIGHT, (0.0,) * 12 + (0.1, 0.2))
    with refused(found="tilted sensor cannot be rotated", expected="an upright image"):
        camera.upright(Orientation.from_exif(6))
    assert camera.upright(Orientation.from_exif(3)).distortion[12:] == (-0.1, -0.2)
