"""Where a photo's camera comes from: EXIF, files, a focal length or a field of view; and what is refused."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from bidnerf_core.camera import (
    UPRIGHT,
    CameraSource,
    Exif,
    Intrinsics,
    Orientation,
    Raster,
    ResolvedCamera,
    read_camera,
    read_exif,
)
from bidnerf_core.datasets import open_dataset
from photo_files import noise, write_photo
from refusals import refused

SIZE = (4032, 3024)
PHOTO = Raster(*SIZE, UPRIGHT)
PORTRAIT = Raster(*SIZE, Orientation.from_exif(6))
WAYS = "`camera` (a file), `focal` (pixels) or `hfov` (degrees)"


def found(exif: Exif = Exif(), raster: Raster = PHOTO, **given: Any) -> Intrinsics:  # noqa: B008
    return find_camera(raster, exif, **given).intrinsics


def find_camera(raster: Raster, exif: Exif, **given: Any) -> ResolvedCamera:
    return CameraSource(**given).find("a.jpg", raster, exif)


# EXIF.


F26 = math.hypot(*SIZE) / math.hypot(36, 24) * 26  # pixels: the equivalent focal length refers to the diagonal
SMALL, WIDE = (Intrinsics.from_focal(f, 400, 300) for f in (300, 500))
FILM = Intrinsics.from_focal(90, 320, 180)
PHONE, PIXELS = Exif(equivalent_mm=26), Exif(size=SIZE, focal_mm=4.0, pixels_per_mm=(700.0, 700.0))
TAKEN = replace(PHONE, size=SIZE)
FOUND: dict[str, tuple[Raster, Exif, list[Intrinsics], Intrinsics, str]] = {
    # The image, its tags, and the assumed cameras; the camera that is found, and a part of its description.
    "equivalent": (
        PHOTO,
        PHONE,
        [],
        Intrinsics.from_focal(F26, *SIZE),
        "26 mm equivalent in EXIF: fx 3029 px at 4032x3024 (the principal point is assumed to be the image centre)",
    ),
    "equivalent, though a camera is assumed": (PHOTO, PHONE, [SMALL], Intrinsics.from_focal(F26, *SIZE), "in EXIF"),
    "portrait": (PORTRAIT, PHONE, [], Intrinsics.from_focal(F26, *SIZE[::-1]), "in EXIF"),
    "pixels of the sensor": (PHOTO, PIXELS, [], Intrinsics.from_focal(2800, *SIZE), "4 mm, pixel size in EXIF"),
    "reduced since": (Raster(2016, 1512), PIXELS, [], Intrinsics.from_focal(1400, 2016, 1512), "in EXIF"),
    "zoomed": (
        PHOTO,
        replace(PIXELS, digital_zoom=2.0),
        [],
        Intrinsics.from_focal(5600, *SIZE),
        "pixel size and digital zoom 2 in EXIF",
    ),
    "turned tags": (PHOTO, replace(PHONE, size=SIZE[::-1]), [], Intrinsics.from_focal(F26, *SIZE), "in EXIF"),
    **{
        f"median of the same shape, {raster.orientation}": (
            raster,
            Exif(),
            [WIDE, FILM, SMALL, SMALL],
            Intrinsics.from_focal(300 * 4032 / 400, *raster.upright_size),
            "assumed to be that of the map's images",
        )
        for raster in (PHOTO, PORTRAIT)
    },
    "exactly this size comes first": (
        Raster(400, 300),
        Exif(),
        [WIDE, replace(SMALL, width=800, height=600), WIDE],
        WIDE,
        "assumed",
    ),
    "a centre crop": (
        Raster(250, 250),
        Exif(),
        [SMALL],
        Intrinsics.from_focal(300 * 250 / 300, 250, 250),
        "assumed to be that of centre crops of the map's images",
    ),
    **{
        f"{what} of {exif.equivalent_mm} mm": (
            Raster(*size),
            exif,
            [SMALL],
            Intrinsics.from_focal(factor * focal, *size),
            "; cropped from a photo of 4032x3024",
        )
        for exif, focal in ((TAKEN, F26), (replace(PIXELS, digital_zoom=2.0), 5600.0))
        for what, size, factor in (
            ("cropped", (1200, 3000), 1),
            ("cropped and resized", (1080, 1080), 1080 / 3024),
            ("cropped and enlarged", (8064, 4536), 2),
        )
    },
}


@pytest.mark.parametrize("kind", FOUND)
def test_the_camera_of_exif_or_the_one_that_is_assumed(kind: str) -> None:
    raster, exif, assumed, expected, description = FOUND[kind]
    source = find_camera(raster, exif, assumed=assumed)
    torch.testing.assert_close(source.intrinsics.matrix(), expected.matrix())
    assert (source.intrinsics.width, source.intrinsics.height) == (expected.width, expected.height)
    assert source.approximate
    assert description in source.description
    assert not find_camera(raster, exif, focal=3000, assumed=assumed).approximate


@pytest.mark.parametrize(
    ("raster", "exif", "message", "expected"),
    [
        *(
            (raster, replace(PHONE, size=size), f"{sizes} when EXIF was written; give its camera: {WAYS}", None)
            for raster, size, sizes in (
                (PHOTO, (4032, 2268), "4032x3024, but was 4032x2268"),
                (Raster(1200, 3000), SIZE, "1200x3000, but was 4032x3024"),
            )
        ),
        *(
            (PHOTO, exif, "no focal length in EXIF", f"a camera: {WAYS}")
            for exif in (Exif(), Exif(focal_mm=4.2), Exif(pixels_per_mm=(700.0, 700.0)))
        ),
    ],
)
def test_without_a_focal_length_or_cropped_since_the_ways_to_give_a_camera_are_named(
    raster: Raster, exif: Exif, message: str, expected: str | None
) -> None:
    with refused(where="a.jpg", found=message, expected=expected):
        found(exif, raster)


def test_tags_are_read_from_the_file(tmp_path: Path) -> None:
    path = write_photo(
        tmp_path / "a.jpg",
        noise(30, 40),
        8,
        FocalLengthIn35mmFilm=28,
        FocalLength=4.25,
        FocalPlaneXResolution=2540.0,
        FocalPlaneYResolution=2540.0,
        FocalPlaneResolutionUnit=3,
        DigitalZoomRatio=1.5,
        ExifImageWidth=40,
        ExifImageHeight=30,
    )
    assert read_exif(path) == Exif(Orientation.from_exif(8), (40, 30), 28.0, 4.25, (254.0, 254.0), 1.5)


@pytest.mark.parametrize(
    "tags",
    [
        {"FocalLengthIn35mmFilm": 0, "DigitalZoomRatio": 0.0, "FocalLength": 0.0},
        {"FocalPlaneXResolution": 254.0, "FocalPlaneResolutionUnit": 9},
        {"ExifImageWidth": 0, "ExifImageHeight": 30},
    ],
)
def test_tags_that_make_no_sense_count_as_missing(tmp_path: Path, tags: dict[str, Any]) -> None:
    assert read_exif(write_photo(tmp_path / "a.jpg", noise(30, 40), **tags)) == Exif()


def test_damaged_exif_counts_as_missing(tmp_path: Path) -> None:
    path = write_photo(tmp_path / "a.jpg", noise(30, 40), 6, FocalLengthIn35mmFilm=28)
    content = path.read_bytes()
    place = content.index(b"Exif\0\0") + 6
    path.write_bytes(content[:place] + b"\xff" * 20 + content[place + 20 :])
    assert read_exif(path) == Exif()


def test_tags_that_take_longer_to_parse_than_the_photo_are_ignored(tmp_path: Path) -> None:
    tags = Image.Exif()
    tags[0x0112], tags[0x9286] = 6, b"a" * 2**20
    Image.new("RGB", (4, 3)).save(tmp_path / "a.png", exif=tags)
    assert read_exif(tmp_path / "a.png") == Exif()


@pytest.mark.data
def test_exif_of_a_phone_is_near_what_calibration_found(data_dir: Path) -> None:
    """Within 10 %: EXIF rounds to a millimetre, and describes the lens focused at infinity."""
    capture = open_dataset(data_dir / "phone_doll")
    for path in sorted((data_dir / "phone_doll/photos").glob("*.jpg")):
        exif = read_exif(path)
        assert exif.equivalent_mm == 26
        assert exif.size == SIZE
        calibrated = capture.views("test", [path.stem])[0].frame.intrinsics.resized(*SIZE)
        assert found(exif).fx == pytest.approx(calibrated.fx, rel=0.1)


# What the user gives.


def test_focal_length_and_field_of_view_agree() -> None:
    camera = found(hfov=70.0)
    assert math.degrees(2 * math.atan(camera.width / 2 / camera.fx)) == pytest.approx(70)
    assert found(Exif(equivalent_mm=26), focal=camera.fx) == camera  # what the user gives goes before EXIF
    assert camera == Intrinsics.from_hfov(70.0, *SIZE)
    assert found(focal=3000.0, raster=PORTRAIT).width == 3024


@pytest.mark.parametrize(
    "arguments",
    [{"focal": 1.0, "hfov": 20.0}, {"focal": 1.0, "camera": "a.json"}, {"hfov": 1.0, "camera": "a"}],
)
def test_several_cameras_are_refused(arguments: dict[str, Any]) -> None:
    with refused(where="a.jpg", found="several cameras", expected=f"one of {WAYS}"):
        found(**arguments)


@pytest.mark.parametrize(
    ("arguments", "value", "expected"),
    [
        *(({"focal": x}, f"fx is {x}", "positive") for x in (0.0, -3.0, math.nan)),
        *(({"focal": x}, f"fx is {x}", "at most 1e+09 pixels") for x in (math.inf, 1e300)),
        ({"focal": 1001 * max(SIZE)}, f"focal length is {1001 * max(SIZE)} px", "1000 times its longer side"),
        *(({"focal": x}, f"fx is {x}", "at least 1e-06 pixels") for x in (1e-9, 1e-308)),
        *(({"hfov": x}, x, "degrees, more than 3 and at most 170") for x in (0.0, 171.0, -20.0, math.nan, 360.0)),
        ({"hfov": 1.18}, 1.18, "(radians? then 67.61 degrees; for a telescope, the focal length: `focal`)"),
    ],
)
def test_numbers_that_no_camera_has_are_refused(arguments: dict[str, float], value: object, expected: str) -> None:
    with refused(where="a.jpg", found=value, expected=expected):
        found(**arguments)


def test_a_camera_of_another_resolution_is_scaled() -> None:
    given = Intrinsics(1500.0, 1510.0, 1000.0, 760.0, 2016, 1512, (0.1, 0, 0, 0))
    assert found(camera=given) == Intrinsics(3000.0, 3020.0, 2000.0, 1520.0, *SIZE, (0.1, 0, 0, 0))
    with refused(where="a.jpg", found="4032x3024, but its camera is for 1512x1512", expected="same aspect ratio"):
        found(camera=Intrinsics(1500.0, 1500.0, 700.0, 700.0, 1512, 1512))


def test_a_camera_is_turned_with_the_image_that_it_is_for() -> None:
    stored = Intrinsics(3000.0, 3010.0, 2000.0, 1500.0, *SIZE)
    upright = stored.upright(PORTRAIT.orientation)
    assert found(raster=PORTRAIT, camera=stored) == upright
    assert found(raster=PORTRAIT, camera=upright) == upright
    half = found(raster=PORTRAIT, camera=stored.scaled(0.5))
    assert (half.fx, half.cx, half.cy) == pytest.approx((upright.fx, upright.cx, upright.cy))


# Files.


def test_json_of_a_dataset_and_json_of_a_camera(tmp_path: Path) -> None:
    path = tmp_path / "cameras.json"
    header = {"fl_x": 3000, "fl_y": 3010, "cx": 2000, "cy": 1500, "w": 4032, "h": 3024, "k1": 0.1}
    expected = Intrinsics(3000.0, 3010.0, 2000.0, 1500.0, *SIZE, (0.1, 0, 0, 0))
    for content in (header, {**header, "frames": [{"file_path": "a.png"}]}):
        path.write_text(json.dumps(content))
        assert found(camera=path) == expected
        assert found(camera=str(path)) == expected
    path.write_text(json.dumps({"camera_angle_x": math.radians(70)}))
    assert found(camera=path).fx == pytest.approx(Intrinsics.from_hfov(70.0, *SIZE).fx)


MODELS = {
    "SIMPLE_PINHOLE": "f cx cy",
    "PINHOLE": "fx fy cx cy",
    "SIMPLE_RADIAL": "f cx cy k1",
    "RADIAL": "f cx cy k1 k2",
    "OPENCV": "fx fy cx cy k1 k2 p1 p2",
    "FULL_OPENCV": "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6",
}
"""COLMAP's models by the names of their parameters, of which ``f`` is both focal lengths."""
LENS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
FOCAL, CENTRE, COEFFICIENT = st.floats(1000, 5000), st.floats(1000, 3000), st.floats(-0.05, 0.05)


@pytest.mark.parametrize("model", MODELS)
@given(data=st.data())
def test_models_of_colmap_are_those_of_pycolmap(model: str, data: st.DataObject, tmp_path: Path) -> None:
    names = MODELS[model].split()
    numbers = [data.draw({"f": FOCAL, "c": CENTRE}.get(name[0], COEFFICIENT), name) for name in names]
    line = f"{model} 4032 3024 {' '.join(map(str, numbers))}"
    values = dict(zip(names, numbers, strict=True))
    fx, fy = values.get("fx", values.get("f")), values.get("fy", values.get("f"))
    lens = tuple(values.get(name, 0.0) for name in LENS)[: 8 if "k3" in values else 4]
    path = tmp_path / "cameras.txt"
    for text in (f"# Camera list\n#   CAMERA_ID, MODEL\n1 {line}\n\n", f"1 {line}\n2 {line}\n"):  # one lens
        path.write_text(text)
        camera = read_camera(path, SIZE)
        assert camera == Intrinsics(fx, fy, values["cx"], values["cy"], *SIZE, lens if any(lens) else ())  # type: ignore[arg-type]
    theirs = pytest.importorskip("pycolmap").Camera(model=model, width=4032, height=3024, params=numbers)
    points = torch.tensor([[0.3, -0.2, 1.0], [-0.4, 0.1, 1.5], [0.1, 0.5, 2.0]], dtype=torch.float64)
    torch.testing.assert_close(camera.project(points), torch.from_numpy(theirs.img_from_cam(points.numpy())))


@pytest.mark.parametrize(
    ("content", "where", "why", "expected"),
    [
        ("# nothing\n", "", "0 cameras", "exactly one"),
        ("1 PINHOLE 4 3 1 1 2 2\n2 PINHOLE 4 3 2 1 2 2\n", "", "2 cameras", "exactly one"),
        ("1 PINHOLE 3 4\n", "", "line 1 has 4 entries", "hloc's list of images"),
        ("1 PINHOLE 4 3 a 1 2 2\n", "", "line 1: could not convert", "CAMERA_ID"),
        ("1 THIN_PRISM_FISHEYE 4 3 1 1 2 2 0 0 0\n", ": line 1", "THIN_PRISM_FISHEYE", "SIMPLE_PINHOLE"),
        ("\n1 PINHOLE 4 3 1 1 2\n", ": line 2", "PINHOLE has 3 parameters", 4),
        ("1 PINHOLE 4 3 -1 1 2 2\n", ": line 1", "fx is -1.0", "positive"),
        ("{,", "", "not JSON", None),
        ("[]", "", "holds []", "a JSON object"),
        ("{}", "", "no focal length", "fl_x"),
        ('{"fl_x": 3000, "is_fisheye": 1, "cx": -5}', "", "maps no ray to a side of its image", None),
        ('{"fl_x": 3, "cx": 1e308}', "", "cx is 1e+308", "pixels near the image"),
        ('{"fl_x": 1e-308}', "", "fx is 1e-308", "at least"),
        ('{"fl_x": 3, "k1": 1e308}', "", "1e+308", "coefficients of a real lens"),
    ],
)
def test_files_that_hold_no_camera(content: str, where: str, why: str, expected: object, tmp_path: Path) -> None:
    path = tmp_path / "camera"
    path.write_text(content)
    with refused(where=f"{path}{where}", found=why, expected=expected):
        found(camera=path)
