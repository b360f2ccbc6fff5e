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


def test_an_equivalent_focal_length_refers_to_the_diagonal() -> None:
    """The diagonal of the image subtends the angle that 43.27 mm subtend at that focal length."""
    source = find_camera(PHOTO, Exif(equivalent_mm=26))
    camera = source.intrinsics
    half = math.atan(math.hypot(camera.width, camera.height) / 2 / camera.fx)
    assert half == pytest.approx(math.atan(math.hypot(36, 24) / 2 / 26))
    assert (camera.cx, camera.cy, camera.fx) == (2016, 1512, camera.fy)
    assert source.description == (
        "26 mm equivalent in EXIF: fx 3029 px at 4032x3024 (the principal point is assumed to be the image centre)"
    )


def test_a_focal_length_and_the_pixels_of_the_sensor() -> None:
    taken = Exif(size=SIZE, focal_mm=4.0, pixels_per_mm=(700.0, 700.0))
    assert found(taken).fx == pytest.approx(2800)
    assert found(taken, Raster(2016, 1512, UPRIGHT)).fx == pytest.approx(1400)  # was reduced since
    zoomed = Exif(size=SIZE, focal_mm=4.0, pixels_per_mm=(700.0, 700.0), digital_zoom=2.0)
    assert found(zoomed).fx == pytest.approx(5600)
    assert "digital zoom 2" in find_camera(PHOTO, zoomed).description


def test_a_portrait_photo_is_as_wide_as_it_was_high() -> None:
    camera = found(Exif(equivalent_mm=26), PORTRAIT)
    assert (camera.width, camera.height, camera.cx) == (3024, 4032, 1512)
    assert camera.fx == found(Exif(equivalent_mm=26)).fx


def test_a_photo_that_was_cropped_since_is_refused() -> None:
    for taken in (SIZE, SIZE[::-1]):
        assert found(Exif(size=taken, equivalent_mm=26)).fx > 0
    with refused(where="a.jpg", found=f"4032x3024, but was 4032x2268 when EXIF was written; give its camera: {WAYS}"):
        found(Exif(size=(4032, 2268), equivalent_mm=26))


@pytest.mark.parametrize("exif", [Exif(), Exif(focal_mm=4.2), Exif(pixels_per_mm=(700.0, 700.0))])
def test_without_a_focal_length_the_ways_to_give_one_are_named(exif: Exif) -> None:
    with refused(where="a.jpg", found="no focal length in EXIF", expected=f"a camera: {WAYS}"):
        found(exif)


def test_without_a_focal_length_the_median_of_images_of_the_same_shape_is_assumed() -> None:
    small, wide = (Intrinsics.from_focal(f, 400, 300) for f in (300, 500))
    film = Intrinsics.from_focal(90, 320, 180)
    for raster in (PHOTO, PORTRAIT):
        source = find_camera(raster, Exif(), assumed=[wide, film, small, small])
        assert source.approximate
        assert source.intrinsics == Intrinsics.from_focal(300 * 4032 / 400, *raster.upright_size)
        assert "assumed to be that of the map's images" in source.description
    same = find_camera(Raster(400, 300), Exif(), assumed=[wide, replace(small, width=800, height=600), wide])
    assert same.intrinsics == wide  # images of exactly this size come before others of the same shape
    square = find_camera(Raster(250, 250, UPRIGHT), Exif(), assumed=[small])
    assert square.intrinsics == Intrinsics.from_focal(300 * 250 / 300, 250, 250)
    assert "assumed to be that of centre crops of the map's images" in square.description
    tagged = Exif(equivalent_mm=26)
    assert find_camera(PHOTO, tagged, assumed=[small]).intrinsics == found(tagged)
    assert not find_camera(PHOTO, Exif(), focal=3000, assumed=[small]).approximate


@pytest.mark.parametrize(
    "exif", [Exif(equivalent_mm=26), Exif(focal_mm=4.2, pixels_per_mm=(700.0, 700.0), digital_zoom=2.0)]
)
def test_a_cropped_photo_has_the_focal_length_of_the_whole_one_where_it_is_estimated(exif: Exif) -> None:
    whole, part = replace(exif, size=SIZE), Raster(1200, 3000, UPRIGHT)
    assumed = [Intrinsics.from_focal(300, 400, 300)]
    source = find_camera(part, whole, assumed=assumed)
    assert source.approximate
    assert source.intrinsics == Intrinsics.from_focal(found(exif).fx, 1200, 3000)
    assert source.description.endswith("cropped from a photo of 4032x3024")
    square = find_camera(Raster(1080, 1080, UPRIGHT), whole, assumed=assumed)  # resized as well
    assert square.intrinsics.fx == pytest.approx(found(exif).fx * 1080 / 3024)
    large = find_camera(Raster(8064, 4536, UPRIGHT), whole, assumed=assumed)
    assert large.intrinsics.fx == pytest.approx(found(exif).fx * 2)
    with refused(found="1200x3000, but was 4032x3024"):
        find_camera(part, whole)


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
    [{"focal": 1.0, "hfov": 2.0}, {"focal": 1.0, "camera": "a.json"}, {"hfov": 1.0, "camera": "a"}],
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
        *(({"hfov": x}, x, "degrees between 0 and 180") for x in (0.0, 180.0, -20.0, math.nan, 360.0)),
        ({"hfov": 0.01}, "px for an image of 4032x3024", "1000 times its longer side"),
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
        ("1 PINHOLE 3 4\n", "", "line 1 has 4 entries", "CAMERA_ID"),
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
