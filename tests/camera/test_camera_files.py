"""Camera files of other programs, cameras of OpenCV's matrices, and focal lengths that cannot be pixels."""

from __future__ import annotations

import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from bidnerf_core.camera import CameraSource, CentralLens, Intrinsics, read_camera
from bidnerf_core.datasets import Photos, depth_files
from bidnerf_core.errors import InputError
from bidnerf_core.frames import Frame
from photo_files import noise, write_photo

SIZE = (640, 480)
K = np.array([[500.0, 0, 310.5], [0, 510.0, 240.25], [0, 0, 1]])
D = (0.1, -0.2, 0.001, 0.002, 0.05)
CAMERA = Intrinsics(500.0, 510.0, 311.0, 240.75, *SIZE, D)
IDEAL = Intrinsics(500.0, 510.0, 311.0, 240.75, *SIZE)

ROS_INFO = f"""image_width: 640
image_height: 480
camera_name: narrow_stereo
camera_matrix:
  rows: 3
  cols: 3
  data: {K.ravel().tolist()}
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [1e-1, -0.2, 0.001, 0.002, 0.05]
"""
ROS_TOPIC = """header:
  stamp:
    sec: 1
    nanosec: 5
  frame_id: camera
height: 480
width: 640
distortion_model: plumb_bob
d:
- 0.1
- -0.2
- 0.001
- 0.002
- 0.05
k:
- 500.0
- 0.0
- 310.5
- 0.0
- 510.0
- 240.25
- 0.0
- 0.0
- 1.0
---
"""
ORB_SLAM = """%YAML:1.0
#--- ORB-SLAM ---
Camera.type: "PinHole"
Camera.fx: 500.0
Camera.fy: 510.0
Camera.cx: 310.5
Camera.cy: 240.25
Camera.k1: 0.1
Camera.k2: -0.2
Camera.p1: 0.001
Camera.p2: 0.002
Camera.k3: 0.05
Camera.width: 640
Camera.height: 480
"""
KALIBR = """cam0:
  camera_model: pinhole
  distortion_coeffs: [0.1, -0.2, 0.001, 0.002]
  distortion_model: radtan
  intrinsics: [500.0, 510.0, 310.5, 240.25]
  resolution: [640, 480]
"""
OPEN3D = {"width": 640, "height": 480, "intrinsic_matrix": K.T.ravel().tolist()}
SPLATS = [
    {"id": 0, "img_name": "a", "width": 640, "height": 480, "fx": 500.0, "fy": 510.0},
    {"id": 1, "img_name": "b.png", "width": 640, "height": 480, "fx": 600.0, "fy": 610.0},
]
HLOC = """dir/a.jpg PINHOLE 640 480 500 510 311 240.75
dir/b.jpg SIMPLE_RADIAL 640 480 500 311 240.75 0.1
"""


def test_a_matrix_of_opencv_gives_the_camera_with_the_half_pixel() -> None:
    for matrix in (K, K.tolist(), torch.from_numpy(K), K.ravel(), K.astype(np.float32)):
        for lens in (D, np.array(D)[None], torch.tensor(D), list(D)):
            found = Intrinsics.from_opencv(matrix, lens, SIZE)
            assert found.distortion == pytest.approx(D)
            assert (found.cx, found.cy, found.fx) == pytest.approx((311.0, 240.75, 500.0))
    assert Intrinsics.from_opencv(K, np.zeros((5, 1)), np.array(SIZE)) == IDEAL
    assert Intrinsics.from_opencv(K, size=SIZE) == IDEAL
    points = np.random.default_rng(0).uniform([-1, -1, 2], [1, 1, 4], (50, 3))
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, np.array(D))
    pixels = CAMERA.project(torch.from_numpy(points)).numpy() - 0.5  # OpenCV's: the first pixel is (0, 0)
    np.testing.assert_allclose(pixels, expected[:, 0], atol=1e-9)


def test_coefficients_may_be_an_array() -> None:
    for lens in (np.array(D), torch.tensor(D, dtype=torch.float64), np.array(D)[:, None]):
        assert Intrinsics(500.0, 510.0, 311.0, 240.75, *SIZE, lens) == CAMERA  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ((K[:2], None, SIZE), r"K has shape \(2, 3\), expected the 3 x 3 matrix"),
        ((K.T, None, SIZE), r"expected rows \(fx 0 cx\), \(0 fy cy\), \(0 0 1\) in pixels"),
        ((K, None, None), r"size is None, expected \(width, height\)"),
        ((K, None, (640.5, 480)), r"width is 640\.5, expected a whole number"),
        ((K, D[:3], SIZE), r"distortion has 3 coefficients, expected 0, 4, 5"),
        ((K * np.nan, None, SIZE), "K has values that are NaN"),
        (("K", None, SIZE), "K is 'K', expected an array of numbers"),
        (
            (np.diag([4.2, 4.2, 1]), None, SIZE),
            r"focal length is 4\.2 px .* is that millimetres\? Expected pixels",
        ),
    ],
)
def test_what_is_no_camera_of_opencv(arguments: tuple[object, object, object], said: str) -> None:
    with pytest.raises(InputError, match=said):
        Intrinsics.from_opencv(*arguments)  # type: ignore[arg-type]


def test_a_bare_matrix_is_told_how_to_become_a_camera(tmp_path: Path) -> None:
    path = write_photo(tmp_path / "a.png", noise(480, 640))
    with pytest.raises(
        InputError, match=r"a\.png: camera is a ndarray, expected .*from_opencv\(K, distortion"
    ):
        Frame.open(path, camera=K)  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"camera is a ndarray, expected .*Intrinsics\.from_opencv\(K, dist"):
        Frame.from_numpy(noise(480, 640), K)  # type: ignore[arg-type]


def test_focal_lengths_in_millimetres_are_questioned(tmp_path: Path) -> None:
    path = write_photo(tmp_path / "a.png", noise(300, 400))
    with pytest.raises(
        InputError, match=r"a\.png: focal length is 4\.2 px for an image of 400x300, which would see 178"
    ):
        Frame.open(path, focal=4.2)
    assert Frame.open(path, focal=60.0).intrinsics.fx == 60
    assert Intrinsics.from_focal(4.2, 24, 16).fx == 4.2, "small images have short focal lengths"
    camera = tmp_path / "camera.json"
    camera.write_text(json.dumps({"fl_x": 26, "w": 4000, "h": 3000}))
    with pytest.raises(InputError, match=r"camera\.json: focal length is 26 px .*\(2000 to 8000\)"):
        Frame.open(path, camera=camera)


YAML_OF_OPENCV = cv2.FileStorage_WRITE | cv2.FileStorage_MEMORY


def opencv_yaml(**values: object) -> str:
    storage = cv2.FileStorage(".yaml", YAML_OF_OPENCV)
    for key, value in values.items():
        storage.write(key, value)
    return str(storage.releaseAndGetString())


CALIBRATED = opencv_yaml(
    image_width=640, image_height=480, camera_matrix=K, distortion_coefficients=np.array(D)
)


@pytest.mark.parametrize(
    ("name", "content", "expected"),
    [
        ("info.yaml", ROS_INFO, CAMERA),
        ("topic.yml", ROS_TOPIC, CAMERA),
        ("opencv.yml", CALIBRATED, CAMERA),
        ("no_size", opencv_yaml(cameraMatrix=K, distCoeffs=np.array(D)), CAMERA),
        ("slam.yaml", ORB_SLAM, CAMERA),
        ("kalibr.yaml", KALIBR, Intrinsics(500.0, 510.0, 311.0, 240.75, *SIZE, D[:4])),
        ("open3d.json", json.dumps(OPEN3D), IDEAL),
        ("view.json", json.dumps({"extrinsic": [1.0] * 16, "intrinsic": OPEN3D}), IDEAL),
        ("path.json", json.dumps({"parameters": [{"intrinsic": OPEN3D}] * 3}), IDEAL),
        ("splats.json", json.dumps(SPLATS), Intrinsics(500.0, 510.0, 320.0, 240.0, *SIZE)),
        ("list.txt", HLOC, IDEAL),
    ],
)
def test_camera_files_of_other_programs(
    name: str, content: str, expected: Intrinsics, tmp_path: Path
) -> None:
    (tmp_path / name).write_text(content)
    found = read_camera(tmp_path / name, SIZE, "elsewhere/a.jpg")
    assert isinstance(found, Intrinsics)
    assert found.distortion == pytest.approx(expected.distortion)
    assert found == Intrinsics(expected.fx, expected.fy, expected.cx, expected.cy, *SIZE, found.distortion)


@pytest.mark.parametrize(
    ("content", "model"),
    [
        (
            ROS_INFO.replace("plumb_bob", "equidistant")
            .replace(", 0.05]", "]")
            .replace("cols: 5", "cols: 4"),
            "ROS",
        ),
        (KALIBR.replace("radtan", "equidistant"), "Kalibr"),
        (ORB_SLAM.replace("PinHole", "KannalaBrandt8").replace("p1", "k3").replace("p2", "k4"), "ORB-SLAM"),
    ],
)
def test_fisheye_calibrations(content: str, model: str, tmp_path: Path) -> None:
    (tmp_path / "c.yaml").write_text(content)
    found = read_camera(tmp_path / "c.yaml", SIZE)
    assert isinstance(found, CentralLens), model
    assert (found.fx, found.cx, found.cy) == (500.0, 311.0, 240.75)
    assert found.coefficients[:2] == (0.1, -0.2)


def test_the_camera_of_a_photo_is_chosen_by_its_name(tmp_path: Path) -> None:
    (tmp_path / "list.txt").write_text(HLOC)
    (tmp_path / "splats.json").write_text(json.dumps(SPLATS))
    assert read_camera(tmp_path / "list.txt", SIZE, "dir/b.jpg") != IDEAL
    for name in ("b.png", "folder/b.png", "b", "C:\\photos\\b.png"):
        found = read_camera(tmp_path / "splats.json", SIZE, name)
        assert isinstance(found, Intrinsics)
        assert found.fx == 600
    for file in ("list.txt", "splats.json"):
        with pytest.raises(
            InputError, match=rf"{file}: holds 2 cameras, expected exactly one, or one named after"
        ):
            read_camera(tmp_path / file, SIZE, "c.jpg")
    for name in ("a", "b"):
        write_photo(tmp_path / f"{name}.png", noise(48, 64))
    queries = Photos([tmp_path / "a.png", tmp_path / "b.png"], CameraSource(tmp_path / "splats.json"))
    assert [queries.read(place).frame.intrinsics.fx for place in range(2)] == [50, 60]


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("a: [1, 2", "is not YAML"),
        ("just words", "expected YAML from ROS"),
        ("image_width: 640\n", "no camera matrix"),
        (
            ROS_INFO.replace("plumb_bob", "double_sphere"),
            "distortion model double_sphere, expected plumb_bob",
        ),
        (ROS_INFO.replace("500.0", "fast"), "expected numbers"),
        (ROS_INFO.replace("500.0", "-500.0"), "focal length fx is -500.0"),
        (KALIBR + KALIBR.replace("cam0", "cam1"), "holds 2 cameras, expected one"),
        (KALIBR.replace("pinhole", "omni"), "camera_model is omni"),
        ("x: !!python/object/apply:os.system ['true']", "no camera matrix"),
    ],
)
def test_calibrations_that_are_none(content: str, said: str, tmp_path: Path) -> None:
    (tmp_path / "c.yaml").write_text(content)
    with pytest.raises(InputError, match=f"^{re.escape(str(tmp_path / 'c.yaml'))}: .*{said}") as caught:
        read_camera(tmp_path / "c.yaml", SIZE)
    assert "\n" not in str(caught.value)


def test_photos_of_equal_names_need_no_depth() -> None:
    photos = [Path("cam0/0001.jpg"), Path("cam1/0001.jpg")]
    assert depth_files(photos, []) == {}
    assert Photos(photos).names == ["cam0_0001", "cam1_0001"]
