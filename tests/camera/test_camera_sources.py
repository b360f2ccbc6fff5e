"""Where a photo's camera comes from: EXIF, files, a focal length or a field of view; and what is refused."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from bidnerf_core.camera import (
    UPRIGHT,
    CameraSource,
    Exif,
    FoundCamera,
    Intrinsics,
    Orientation,
    Raster,
    read_camera,
    read_exif,
)
from bidnerf_core.datasets import open_dataset
from bidnerf_core.errors import InputError
from photo_files import noise, write_photo

SIZE = (4032, 3024)
PHOTO = Raster(*SIZE, UPRIGHT)
PORTRAIT = Raster(*SIZE, Orientation.from_exif(6))
WAYS = r"--camera FILE, --focal PX or --hfov DEG \(camera=, focal=, hfov= in Python\)"
WAYS_OF_PHOTO = r"--camera FILE, --focal PX or --hfov DEG \(in Python camera=, focal=, hfov=, or assumed= with a map's cameras\)"


def found(exif: Exif = Exif(), raster: Raster = PHOTO, **given: Any) -> Intrinsics:  # noqa: B008
    return find_camera(raster, exif, **given).intrinsics


def find_camera(raster: Raster, exif: Exif, **given: Any) -> FoundCamera:
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
    with pytest.raises(
        InputError, match=rf"is 4032x3024, but was 4032x2268 when EXIF was written.*{WAYS_OF_PHOTO}"
    ):
        found(Exif(size=(4032, 2268), equivalent_mm=26))


@pytest.mark.parametrize("exif", [Exif(), Exif(focal_mm=4.2), Exif(pixels_per_mm=(700.0, 700.0))])
def test_without_a_focal_length_the_ways_to_give_one_are_named(exif: Exif) -> None:
    with pytest.raises(
        InputError,
        match=rf"^a\.jpg: no focal length in EXIF, expected a camera: {WAYS_OF_PHOTO}$",
    ):
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
    assert find_camera(PHOTO, Exif(equivalent_mm=26), assumed=[small]).intrinsics == found(
        Exif(equivalent_mm=26)
    )
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
    with pytest.raises(InputError, match="is 1200x3000, but was 4032x3024"):
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
    assert found(focal=camera.fx) == camera
    assert camera == Intrinsics.from_hfov(70.0, *SIZE)
    assert found(focal=3000.0, raster=PORTRAIT).width == 3024


def test_what_the_user_gives_goes_before_exif() -> None:
    assert found(Exif(equivalent_mm=26), focal=1234.0).fx == 1234


@pytest.mark.parametrize(
    "given", [{"focal": 1.0, "hfov": 2.0}, {"focal": 1.0, "camera": "a.json"}, {"hfov": 1.0, "camera": "a"}]
)
def test_several_cameras_are_refused(given: dict[str, Any]) -> None:
    with pytest.raises(InputError, match=f"several cameras are given, expected one of {WAYS}"):
        found(**given)


@pytest.mark.parametrize(
    "given", [{"focal": x} for x in (0.0, -3.0, math.nan, math.inf, 1e-308, 1e300)]
    + [{"hfov": x} for x in (0.0, 180.0, -20.0, math.nan, 360.0)],
)  # fmt: skip
def test_numbers_that_no_camera_has_are_refused(given: dict[str, float]) -> None:
    with pytest.raises(InputError, match=r"^a\.jpg: .*expected"):
        found(**given)


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({"focal": 1e30}, "focal length is 1e[+]30 px .* expected at most 1000 times its longer side"),
        ({"focal": 1001 * max(SIZE)}, "expected at most 1000 times its longer side"),
        ({"focal": 1e-9}, "focal length fx is 1e-09, expected at least 1e-06 pixels"),
        ({"hfov": 0.0001}, "view is 0.0001, which gives a focal .*, expected at most 1e[+]09 pixels"),
    ],
)
def test_the_limits_of_a_focal_length_are_stated(given: dict[str, float], expected: str) -> None:
    with pytest.raises(InputError, match=expected):
        found(**given)


def test_the_focal_length_of_a_telescope_is_taken() -> None:
    assert found(focal=999.0 * max(SIZE)).fx == 999.0 * max(SIZE)


def test_a_camera_of_another_resolution_is_scaled() -> None:
    given = Intrinsics(1500.0, 1510.0, 1000.0, 760.0, 2016, 1512, (0.1, 0, 0, 0))
    assert found(camera=given) == Intrinsics(3000.0, 3020.0, 2000.0, 1520.0, *SIZE, (0.1, 0, 0, 0))
    with pytest.raises(
        InputError, match="image is 4032x3024, but its camera is for 1512x1512, expected one with"
    ):
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


@pytest.mark.parametrize(
    ("line", "distortion"),
    [
        ("SIMPLE_PINHOLE 4032 3024 3000 2016 1512", ()),
        ("PINHOLE 4032 3024 3000 3000 2016 1512", ()),
        ("SIMPLE_RADIAL 4032 3024 3000 2016 1512 0.01", (0.01, 0, 0, 0)),
        ("SIMPLE_RADIAL 4032 3024 3000 2016 1512 0", ()),
        ("RADIAL 4032 3024 3000 2016 1512 0.01 0.02", (0.01, 0.02, 0, 0)),
        ("OPENCV 4032 3024 3000 3000 2016 1512 0.01 0.02 0.03 0.04", (0.01, 0.02, 0.03, 0.04)),
        (
            "FULL_OPENCV 4032 3024 3000 3000 2016 1512 .01 .02 .03 .04 .05 .06 .07 .08",
            (0.01, 0.02, 0.03, 0.04, 0.05, 0.06, 0.07, 0.08),
        ),
    ],
)
def test_models_of_colmap(tmp_path: Path, line: str, distortion: tuple[float, ...]) -> None:
    path = tmp_path / "cameras.txt"
    path.write_text(f"# Camera list\n#   CAMERA_ID, MODEL\n1 {line}\n\n")
    expected = Intrinsics(3000.0, 3000.0, 2016.0, 1512.0, *SIZE, distortion)
    assert read_camera(path, SIZE) == expected
    path.write_text(f"1 {line}\n2 {line}\n")  # one lens, two photos
    assert read_camera(path, SIZE) == expected


def test_colmaps_cameras_project_as_pycolmap_does(tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")

    points = torch.tensor([[0.3, -0.2, 1.0], [-0.4, 0.1, 1.5], [0.1, 0.5, 2.0]], dtype=torch.float64)
    for model, parameters in (
        ("RADIAL", [300.0, 200.0, 150.0, 0.1, -0.05]),
        ("FULL_OPENCV", [300.0, 310.0, 200.0, 150.0, 0.1, -0.05, 0.01, 0.02, 0.03, 0.04, 0.05, 0.06]),
    ):
        path = tmp_path / "cameras.txt"
        path.write_text(f"1 {model} 400 300 {' '.join(map(str, parameters))}\n")
        theirs = pycolmap.Camera(model=model, width=400, height=300, params=parameters)
        expected = torch.from_numpy(theirs.img_from_cam(points.numpy()))
        torch.testing.assert_close(read_camera(path, SIZE).project(points), expected)


BAD: dict[str, tuple[Callable[[Path], object], str]] = {
    "missing": (lambda path: None, "no such file, expected a camera file (JSON, YAML, COLMAP's cameras.txt"),
    "folder": (lambda path: path.mkdir(), "is a folder"),
    "binary": (lambda path: path.write_bytes(b"\xff\xfe\x00"), "is not text"),
    "empty": (lambda path: path.write_text("# nothing\n"), "holds 0 cameras, expected exactly one"),
    "short": (lambda path: path.write_text("1 PINHOLE 3 4\n"), "line 1 has 4 entries, expected CAMERA_ID"),
    "fisheye": (
        lambda path: path.write_text("1 THIN_PRISM_FISHEYE 4 3 1 1 2 2 0 0 0 0 0 0 0 0\n"),
        "line 1: camera model THIN_PRISM_FISHEYE, expected one of SIMPLE_PINHOLE",
    ),
    "count": (
        lambda path: path.write_text("\n1 PINHOLE 4 3 1 1 2\n"),
        "line 2: PINHOLE has 3 parameters, expected 4",
    ),
    "words": (lambda path: path.write_text("1 PINHOLE 4 3 a 1 2 2\n"), "line 1: could not convert"),
    "negative": (
        lambda path: path.write_text("1 PINHOLE 4 3 -1 1 2 2\n"),
        "line 1: focal length fx is -1.0, expected a positive number",
    ),
    "several": (
        lambda path: path.write_text("1 PINHOLE 4 3 1 1 2 2\n2 PINHOLE 4 3 2 1 2 2\n"),
        "holds 2 cameras, expected exactly one",
    ),
    "broken JSON": (lambda path: path.write_text("{,"), "not JSON"),
    "JSON list": (lambda path: path.write_text("[]"), "holds [], expected a JSON object"),
    "no focal length": (lambda path: path.write_text("{}"), "no focal length, expected fl_x"),
    "is_fisheye": (
        lambda path: path.write_text('{"fl_x": 3000, "is_fisheye": 1, "cx": -5}'),
        "maps no ray to a side of its image",
    ),
    "far cx": (
        lambda path: path.write_text('{"fl_x": 3, "cx": 1e308}'),
        "principal point cx is 1e+308, expected pixels near the image",
    ),
    "tiny fl_x": (lambda path: path.write_text('{"fl_x": 1e-308}'), "focal length fx is 1e-308"),
    "huge lens": (lambda path: path.write_text('{"fl_x": 3, "k1": 1e308}'), "coefficients of a real lens"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_files(tmp_path: Path, case: str) -> None:
    write, expected = BAD[case]
    path = tmp_path / "camera"
    write(path)
    with pytest.raises(InputError) as caught:
        found(camera=path)
    assert str(caught.value).startswith(str(path))
    assert expected in str(caught.value)
    assert "\n" not in str(caught.value)
