"""Decoding image files and arrays: what they become, and what is said of those that are not usable."""

from __future__ import annotations

import os
import struct
import subprocess
import sys
import tracemalloc
import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
import torch
from PIL import Image, features

from bidnerf_core.frames import as_floats, photos_in

# Inside: the header of an image alone, and a system that refuses to open a file
from bidnerf_core.io import (
    IMAGE_SUFFIXES,
    composite,
    decode,
    files,
    pixel_array,
    read_compact_image,
    read_header,
    read_image,
    reduce_image,
    resample_nearest,
)
from bidnerf_core.io.images import ImageHeader
from bombs import png, png_of
from optional import require
from photo_files import noise
from refusals import refused

READERS = pytest.mark.parametrize("read", [read_image, read_header], ids=["image", "header"])


@READERS
@pytest.mark.parametrize("size", [(13400, 13400), (60000, 60000)])
@pytest.mark.parametrize("limit", [Image.MAX_IMAGE_PIXELS, None])
def test_images_of_too_many_pixels_take_no_memory(
    tmp_path: Path,
    read: Callable[[Path], object],
    size: tuple[int, int],
    limit: int | None,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", limit)  # None: a program switched Pillow's own check off
    path = tmp_path / "bomb.png"
    path.write_bytes(png_of(*size))
    tracemalloc.start()
    with refused(
        where=path, found=f"image has {size[0] * size[1]} pixels", expected="at most 178 megapixels; scale it down"
    ):
        read(path)
    assert tracemalloc.get_traced_memory()[1] < 5e6
    tracemalloc.stop()


@pytest.mark.parametrize(
    ("mode", "has_alpha"), [("L", False), ("LA", True), ("RGB", False), ("RGBA", True), ("1", False)]
)
def test_the_header_says_what_decoding_gives(tmp_path: Path, mode: str, has_alpha: bool) -> None:
    path = tmp_path / "a.png"
    Image.fromarray(noise(6, 9, 4)).convert(mode).save(path)
    colour, alpha = read_image(path)
    assert read_header(path) == ImageHeader(9, 6, has_alpha)
    assert colour.shape == (6, 9, 3)
    assert (alpha is not None) == has_alpha


def test_palettes_become_colours(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    image = Image.fromarray(noise(6, 9)).quantize(16)
    image.save(path)
    expected = torch.from_numpy(np.array(image.convert("RGB"))).float() / 255
    torch.testing.assert_close(read_image(path)[0], expected)
    image.save(path, transparency=0)
    alpha = require(read_image(path)[1])
    assert alpha.equal((torch.from_numpy(np.array(image)) != 0).float())
    assert read_header(path).has_alpha


@pytest.mark.parametrize("bits", [10, 12, 14, 16])
@pytest.mark.parametrize("shape", [(20, 30), (20, 30, 3)])
def test_sixteen_bits_have_the_range_that_the_sensor_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, bits: int, shape: tuple[int, ...]
) -> None:
    values = np.random.default_rng(0).integers(0, 2**bits, shape, dtype=np.uint16)
    values.flat[0] = 2**bits - 1
    path = tmp_path / "a.png"
    cv2.imwrite(str(path), values if values.ndim == 2 else values[..., ::-1])
    expected = torch.from_numpy(values.reshape(20, 30, -1).astype(np.float32) / (2**bits - 1)).expand(20, 30, 3)
    monkeypatch.setattr("bidnerf_core.io.images.STRIP", 90)
    for read in (read_image, read_compact_image):
        found, alpha = read(path)
        assert alpha is None
        torch.testing.assert_close(found, expected)
    if values.ndim == 2:
        assert decode(path).dtype == np.uint16, "depth images keep their values"


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_a_fourth_band_is_alpha_if_the_file_says_so(tmp_path: Path, kind: type) -> None:
    """Photometric 2 is RGB, 1 grey; the extra sample of a band is 0 if it is anything, 2 if it is alpha."""
    bits, values = (
        8 * np.dtype(kind).itemsize,
        np.random.default_rng(0).integers(0, np.iinfo(kind).max, (6, 9, 4), dtype=kind),
    )
    path = tmp_path / "a.tif"

    def write(photometric: int, extra: int) -> None:
        tags = [
            (256, 4, 1, 9),
            (257, 4, 1, 6),
            (258, 3, 4, 8),
            (259, 3, 1, 1),
            (262, 3, 1, photometric),
            (273, 4, 1, 16),
        ]
        tags += [(277, 3, 1, 4), (278, 4, 1, 6), (279, 4, 1, values.nbytes), (338, 3, 1, extra)]
        entries = struct.pack("<H", len(tags)) + b"".join(struct.pack("<HHII", *tag) for tag in tags) + bytes(4)
        header = b"II*\0" + struct.pack("<I4H", 16 + values.nbytes, *4 * [bits])
        path.write_bytes(header + values.tobytes() + entries)

    expected = torch.from_numpy(values / np.float32(2**bits - 1))
    for extra in (0, 2):
        write(2, extra)
        colour, alpha = read_image(path)
        torch.testing.assert_close(colour, expected[..., :3] * (expected[..., 3:] if extra else 1))
        assert (alpha is not None) == (extra == 2)
    write(1, 0)
    with refused(where=path, found="a TIFF file whose bands are not those of grey or colour images"):
        read_image(path)


def test_eight_bits_stay_bytes(tmp_path: Path) -> None:
    for mode in ("L", "RGB", "CMYK", "RGBA", "P"):
        path = tmp_path / f"{mode}.{'jpg' if mode == 'CMYK' else 'png'}"
        image = Image.fromarray(noise(16, 24)).convert("RGB").resize((48, 32))
        (image.quantize(16) if mode == "P" else image.convert(mode)).save(path)
        compact, alpha = read_compact_image(path, (1.0, 1.0, 1.0))
        floats, expected = read_image(path, (1.0, 1.0, 1.0))
        assert (alpha is None) == (expected is None)
        assert (compact.dtype == torch.uint8) == (mode in ("L", "RGB", "CMYK"))
        assert torch.equal(as_floats(compact), floats)


def test_the_first_bytes_count_not_the_name(tmp_path: Path) -> None:
    pixels = noise(16, 24)
    for name, kind in (("a.heic", "JPEG"), ("b.jpg", "PNG"), ("c", "JPEG"), ("d.JPG", "WEBP"), ("e", "TIFF")):
        Image.fromarray(pixels).save(tmp_path / name, format=kind)
        assert read_image(tmp_path / name)[0].shape == (16, 24, 3)
    (tmp_path / "notes.txt").write_text("BMW: no image")
    (tmp_path / "empty").write_bytes(b"")
    photos, others = photos_in(tmp_path)
    assert [photo.name for photo in photos] == ["a.heic", "b.jpg", "c", "d.JPG", "e"]
    assert {other.name for other in others} == {"notes.txt", "empty"}


# Files.


def test_permission_that_is_denied_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.png"
    Image.fromarray(noise(3, 4)).save(path)
    path.chmod(0)
    if os.access(path, os.R_OK):  # nothing is denied to root
        monkeypatch.setattr(files.Path, "open", Mock(side_effect=PermissionError(13, "Permission denied")))
    with refused(where=path, found="permission denied", expected="a readable file: an image file"):
        read_image(path)


def test_heic_without_its_package_names_the_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    path = tmp_path / "IMG_1.jpg"  # the content counts, not the name
    path.write_bytes(b"\0\0\0\x18ftypheic\0\0\0\0mif1heic")
    with refused(where=path, found="pip install 'bidnerf[heif]'"):
        read_image(path)


FOREIGN = {
    "eps": b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 24 24\n%%EndComments\n{} loop\n",
    "psd": b"8BPS\x00\x01" + bytes(6) + struct.pack(">HIIHH", 3, 8, 8, 8, 3) + bytes(40),
    "icns": b"icns" + struct.pack(">I", 16) + b"ic07" + struct.pack(">I", 8),
}


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".eps", ".tif"])
def test_only_formats_of_images_are_decoded_and_no_program_is_started(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, suffix: str
) -> None:
    """EPS is drawn by a program; whatever a file is called, its content is not given to one."""
    started = tmp_path / "started"
    for name in ("gs", "gswin32c", "gswin64c"):
        (tmp_path / name).write_text(f"#!/bin/sh\ntouch {started}\n")
        (tmp_path / name).chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    for kind, content in FOREIGN.items():
        path = tmp_path / f"{kind}{suffix}"
        path.write_bytes(content)
        for read in (read_image, read_header, decode):
            with refused(where=path, found="is in none of the formats PNG, JPEG, TIFF"):
                read(path)
    assert not started.exists()


@pytest.mark.parametrize("mode", ["1", "L", "LA", "P", "RGB", "RGBA"])
def test_strips_give_what_the_whole_image_gives(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, mode: str) -> None:
    path = tmp_path / "a.png"
    image = Image.fromarray(noise(50, 41, 4))
    (image.convert("RGB").quantize(16) if mode == "P" else image.convert(mode)).save(path)
    background = (0.2, 0.5, 0.9)

    def parts() -> list[torch.Tensor | None]:
        whole, small = read_image(path, background), read_image(path, background, (13, 16))
        return [*whole, *small, torch.tensor(decode(path))]

    before = parts()
    monkeypatch.setattr("bidnerf_core.io.images.STRIP", 41 * 7)
    for one, other in zip(before, parts(), strict=True):
        assert one is other is None or torch.equal(one, other)  # type: ignore[arg-type]
    torch.testing.assert_close(before[2], reduce_image(before[0], 13, 16))  # type: ignore[arg-type]


def test_a_large_image_that_is_reduced_takes_little_memory(tmp_path: Path) -> None:
    path = tmp_path / "large.png"
    path.write_bytes(png(6000, 6000, 8, 0, bytes(6001 * 6000)))
    tracemalloc.start()
    rgb, _ = read_image(path, size=(64, 64))
    assert rgb.shape == (64, 64, 3)
    assert tracemalloc.get_traced_memory()[1] < 60e6  # 432 MB as floats
    tracemalloc.stop()


@READERS
@pytest.mark.parametrize(
    "repeated",
    [b"\xff\xe1\x00\x04ab", b"\xff\xda\x00\x08\x01\x01\x00\x00\x3f\x00\x00"],
    ids=["segments", "scans"],
)
def test_a_jpeg_of_endless_segments_or_scans_is_refused(
    tmp_path: Path, read: Callable[[Path], object], repeated: bytes
) -> None:
    path = tmp_path / "a.jpg"
    image = Image.fromarray(noise(40, 60))
    image.save(path, progressive=True, comment=b"\xff\xda" * 300, exif=b"Exif\0\0" + b"\xff\xe1\xff\xd9" * 3000)
    read(path)  # nothing within a segment counts
    content = path.read_bytes()
    path.write_bytes(content + repeated * 5000)  # nor what follows the image, where phones store a video
    read(path)
    path.write_bytes(content[:2] + repeated * 5000 + content[2:])
    with refused(where=path, found="more than 100 scans or 1000 segments"):
        read(path)


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".webp", ".tif"])
def test_every_cut_of_a_file_is_one_line(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    Image.fromarray(noise(20, 30)).save(path)
    whole = path.read_bytes()
    for count in (0, 1, 10, len(whole) // 4, len(whole) // 2, len(whole) * 3 // 4):
        path.write_bytes(whole[:count])
        with refused(where=path):
            read_image(path)


# Arrays.


@pytest.mark.parametrize("kind", ["uint8", "uint16", "float16", "float32", "float64", "bool"])
@pytest.mark.parametrize("torch_array", [False, True])
def test_arrays_are_scaled_by_their_type(kind: str, torch_array: bool) -> None:
    full = {"uint8": 255, "uint16": 65535}.get(kind, 1)
    array = (np.array([[0.0, 1.0], [1.0, 0.0]]) * full).astype(kind)
    found = pixel_array(torch.from_numpy(array) if torch_array else array, "rgb")
    assert found.dtype == torch.float32
    assert found[..., 0].tolist() == [[0, 1], [1, 0]]


def test_what_leaves_the_range_by_rounding_is_clamped() -> None:
    found = pixel_array(np.array([[-5e-4, 1.0005]]), "rgb")
    assert found.flatten().tolist() == [0, 1]


CHANNELS = "(height, width) or (height, width, 1 to 4)"


@pytest.mark.parametrize(
    ("array", "found", "expected"),
    [
        (np.full((2, 2), np.nan), "rgb has floats from nan to nan", "[0, 1]"),
        (np.full((2, 2, 3), np.inf), "rgb has floats from inf to inf", "[0, 1]"),
        (np.linspace(0, 255, 12).reshape(2, 2, 3), "floats from 0 to 255", "[0, 1]; divide by 255"),
        (np.linspace(-1, 1, 12).reshape(2, 2, 3), "rgb has floats from -1 to 1", "[0, 1]"),
        (np.zeros((2, 2, 3), dtype=np.int64), "rgb has dtype int64", "uint8 in [0, 255]"),
        (np.zeros((2, 2, 3), dtype=complex), "rgb has dtype complex128", "uint8"),
        (np.zeros((2, 2), dtype=object), "rgb has dtype object", "uint8"),
        (np.zeros((3, 20, 30)), "rgb has shape (3, 20, 30)", "move the channels last"),
        (np.zeros((20, 30, 5)), "rgb has shape (20, 30, 5)", CHANNELS),
        (np.zeros((20, 0, 3)), "rgb has shape (20, 0, 3)", CHANNELS),
        (np.zeros(20), "rgb has shape (20,)", CHANNELS),
    ],
)
def test_arrays_that_are_no_images(array: np.ndarray, found: str, expected: str) -> None:
    with refused(found=found, expected=expected):
        pixel_array(array, "rgb")


def test_reducing_keeps_means_and_commutes_with_compositing() -> None:
    """An area filter: each new pixel is the mean of a block, and both steps are linear in premultiplied colour."""
    image = torch.from_numpy(noise(12, 20, 4)).float() / 255
    small = reduce_image(image, 5, 3)
    torch.testing.assert_close(small, image.reshape(3, 4, 5, 4, 4).mean((1, 3)))
    torch.testing.assert_close(reduce_image(image, 7, 5).mean((0, 1)), image.mean((0, 1)), atol=1e-5, rtol=0)
    premultiplied = image[..., :3] * image[..., 3:]
    expected = reduce_image(premultiplied, 5, 3) + 0.3 * (1 - small[..., 3:])
    torch.testing.assert_close(reduce_image(composite(image[..., :3], image[..., 3], (0.3,) * 3), 5, 3), expected)


def test_resampling_takes_the_nearest_and_invents_nothing() -> None:
    image = torch.arange(12.0).reshape(3, 4)
    assert resample_nearest(image, 8, 6).equal(image.repeat_interleave(2, 0).repeat_interleave(2, 1))
    assert resample_nearest(resample_nearest(image, 12, 9), 4, 3).equal(image)
    assert set(resample_nearest(image, 7, 5).flatten().tolist()) <= set(image.flatten().tolist())


def test_threads_that_read_images_leave_warnings_as_they_were(tmp_path: Path) -> None:
    """Filters of warnings belong to the process: one that stays behind would silence all later warnings of an application."""
    Image.fromarray(noise(60, 80)).save(tmp_path / "a.png")
    before = list(warnings.filters)
    with ThreadPoolExecutor(4) as pool:
        for _ in pool.map(read_image, [tmp_path / "a.png"] * 400):
            pass
    assert warnings.filters == before


def test_oddities_of_a_file_cause_no_warning(tmp_path: Path) -> None:
    """Run apart, since pytest has filters of its own."""
    path = tmp_path / "large.png"
    path.write_bytes(png_of(9500, 9500))  # Pillow warns from 89 megapixels on
    code = f"from pathlib import Path; from bidnerf_core.io.images import read_header; read_header(Path({str(path)!r}))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr == ""


def test_the_formats_that_photos_have_are_decoded(tmp_path: Path) -> None:
    for suffix in (*IMAGE_SUFFIXES, ".gif", *([".avif"] if features.check("avif") else [])):
        path = tmp_path / f"a{suffix}"
        Image.fromarray(noise(16, 24)).convert("L" if suffix == ".pgm" else "RGB").save(path)
        assert read_image(path)[0].shape == (16, 24, 3)
