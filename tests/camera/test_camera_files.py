"""Camera files of other programs, cameras of OpenCV's matrices, and focal lengths that cannot be pixels."""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
import yaml
from hypothesis import given
from hypothesis import strategies as st

from bidnerf_core.camera import CentralLens, Intrinsics, read_camera
from bidnerf_core.datasets import DatasetOptions, Photos, depth_files
from bidnerf_core.frames import Frame
from bidnerf_core.io import to_plain
from photo_files import noise, write_photo
from refusals import refused

SIZE = (640, 480)
K = np.array([[500.0, 0, 310.5], [0, 510.0, 240.25], [0, 0, 1]])
D = (0.1, -0.2, 0.001, 0.002, 0.05)
CAMERA = Intrinsics(500.0, 510.0, 311.0, 240.75, *SIZE, D)
IDEAL = Intrinsics(500.0, 510.0, 311.0, 240.75, *SIZE)


def matrix(camera: Intrinsics) -> list[float]:
    """The camera matrix in rows, as OpenCV has it: the centre of the first pixel is (0, 0)."""
    return [camera.fx, 0.0, camera.cx - 0.5, 0.0, camera.fy, camera.cy - 0.5, 0.0, 0.0, 1.0]


ROS_INFO = """image_width: 640
image_height: 480
camera_name: narrow_stereo
camera_matrix:
  rows: 3
  cols: 3
  data: {K}
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: {D}
"""
KALIBR = """cam0:
  camera_model: pinhole
  distortion_coeffs: {four}
  distortion_model: radtan
  intrinsics: {focal_and_centre}
  resolution: [640, 480]
"""
ORB_SLAM = """%YAML:1.0
#--- ORB-SLAM ---
Camera.type: "PinHole"
"""
HLOC = """dir/a.jpg PINHOLE 640 480 {camera.fx} {camera.fy} {camera.cx} {camera.cy}
dir/b.jpg SIMPLE_RADIAL 640 480 500 311 240.75 0.1
"""


def ros_info(camera: Intrinsics) -> str:
    return ROS_INFO.format(K=matrix(camera), D=list(camera.distortion))


def ros_topic(camera: Intrinsics) -> str:
    values = {"height": 480, "width": 640, "distortion_model": "plumb_bob", "d": list(camera.distortion)}
    return yaml.safe_dump({"header": {"frame_id": "camera"}, **values, "k": matrix(camera)}) + "---\n"


def orb_slam(camera: Intrinsics) -> str:
    numbers = (camera.fx, camera.fy, camera.cx - 0.5, camera.cy - 0.5, *camera.distortion, *SIZE)
    names = ["fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "width", "height"]
    return ORB_SLAM + "".join(f"Camera.{name}: {x}\n" for name, x in zip(names, numbers, strict=True))


def kalibr(camera: Intrinsics) -> str:
    numbers = [camera.fx, camera.fy, camera.cx - 0.5, camera.cy - 0.5]
    return KALIBR.format(four=list(camera.distortion[:4]), focal_and_centre=numbers)


def opencv(camera: Intrinsics, *names: str, kind: str = ".yaml", **sizes: int) -> str:
    storage = cv2.FileStorage(kind, cv2.FileStorage_WRITE | cv2.FileStorage_MEMORY)
    arrays = (np.array(matrix(camera)).reshape(3, 3), np.array(camera.distortion))
    for name, value in (*sizes.items(), *zip(names, arrays, strict=True)):
        storage.write(name, value)
    return str(storage.releaseAndGetString())


def columns(camera: Intrinsics) -> list[float]:
    """The matrix by columns, as ARKit and Open3D write it."""
    flat: list[float] = np.reshape(matrix(camera), (3, 3)).T.ravel().tolist()
    return flat


def numbers_of(camera: Intrinsics) -> str:
    """The numbers fx fy cx cy of a matrix."""
    return " ".join(map(repr, [camera.fx, camera.fy, camera.cx - 0.5, camera.cy - 0.5]))


def numpy_file(write: Callable[..., None], *arrays: object, **named: object) -> bytes:
    """The file in which NumPy saves arrays."""
    file = io.BytesIO()
    write(file, *arrays, **named)
    return file.getvalue()


def open3d(camera: Intrinsics) -> dict[str, object]:
    return {"width": camera.width, "height": camera.height, "intrinsic_matrix": columns(camera)}


def ost(camera: Intrinsics) -> str:
    """Return the text that ROS's camera_calibration writes for a camera."""
    rows = "\n".join(" ".join(map(repr, matrix(camera)[i : i + 3])) for i in (0, 3, 6))
    lens = " ".join(map(repr, camera.distortion))
    identity = "1 0 0\n0 1 0\n0 0 1"
    return (
        f"# oST version 5.0 parameters\n\n\n[image]\n\nwidth\n640\n\nheight\n480\n\n[narrow_stereo]\n\ncamera matrix\n{rows}\n\n"
        f"distortion\n{lens}\n\nrectification\n{identity}\n\nprojection\n1 0 3 0\n0 1 3 0\n0 0 1 0\n"
    )


def agisoft(camera: Intrinsics) -> str:
    k1, k2, p1, p2, k3 = camera.distortion
    values = {"f": camera.fy, "cx": camera.cx - 320, "cy": camera.cy - 240, "b1": camera.fx - camera.fy}
    values |= {"k1": k1, "k2": k2, "k3": k3, "p1": p2, "p2": p1}
    lens = "".join(f"<{key}>{value!r}</{key}>" for key, value in values.items())
    size = "<projection>frame</projection><width>640</width><height>480</height>"
    return f'<?xml version="1.0"?><calibration>{size}{lens}</calibration>'


def by_names(camera: Intrinsics, **names: str) -> str:
    """The JSON of RealSense and of most scripts, in which ``names`` replace others."""
    values = {
        "width": 640,
        "height": 480,
        "fx": camera.fx,
        "fy": camera.fy,
        "cx": camera.cx - 0.5,
        "cy": camera.cy - 0.5,
    }
    return json.dumps({names.get(key, key): value for key, value in values.items()} | {"coeffs": camera.distortion})


def as_text(camera: Intrinsics, width: int = 3, rows: int = 3) -> str:
    """The matrix as NumPy writes it."""
    K = np.eye(max(rows, 3), width)
    K[:3, :3] = np.array(matrix(camera)).reshape(3, 3)
    return "\n".join(" ".join(map(repr, row)) for row in K.tolist()) + "\n"


def splats(*cameras: Intrinsics) -> str:
    named = zip(("a", "b.png"), cameras, strict=False)
    return json.dumps([{"img_name": x, "width": 640, "height": 480, "fx": c.fx, "fy": c.fy} for x, c in named])


NAMES = ("camera_matrix", "distortion_coefficients")
FILES: dict[str, tuple[Callable[[Intrinsics], str | bytes], int]] = {
    "info.yaml": (ros_info, 5),
    "topic.yml": (ros_topic, 5),
    "opencv.yml": (lambda camera: opencv(camera, *NAMES, image_width=640, image_height=480), 5),
    "no_size": (lambda camera: opencv(camera, "cameraMatrix", "distCoeffs"), 5),
    "slam.yaml": (orb_slam, 5),
    "kalibr.yaml": (kalibr, 4),
    "open3d.json": (lambda camera: json.dumps(open3d(camera)), 0),
    "view.json": (lambda camera: json.dumps({"extrinsic": [1.0] * 16, "intrinsic": open3d(camera)}), 0),
    "path.json": (lambda camera: json.dumps({"parameters": [{"intrinsic": open3d(camera)}] * 3}), 0),
    "splats.json": (splats, 0),
    "opencv.xml": (lambda camera: opencv(camera, *NAMES, kind=".xml", image_width=640, image_height=480), 5),
    "ost.txt": (ost, 5),
    "agisoft.xml": (agisoft, 5),
    "realsense.json": (partial(by_names, cx="ppx", cy="ppy"), 5),
    "script.json": (by_names, 5),
    "mtx.json": (lambda c: json.dumps({"mtx": np.reshape(matrix(c), (3, 3)).tolist(), "dist": [c.distortion]}), 5),
    "own.json": (lambda camera: json.dumps(to_plain(camera)), 5),
    "answer.json": (lambda camera: json.dumps({"name": "a.jpg", "intrinsics": to_plain(camera)}), 5),
    "K.txt": (as_text, 0),
    "K4.txt": (partial(as_text, width=4, rows=4), 0),
    "row.txt": (lambda camera: as_text(camera, width=4).replace("\n", " "), 0),
    "K.json": (lambda camera: json.dumps(np.reshape(matrix(camera), (3, 3)).tolist()), 0),
    "list.txt": (lambda camera: HLOC.format(camera=camera), 0),
    "K.csv": (lambda camera: as_text(camera).replace(" ", ","), 0),
    "four.txt": (lambda camera: "# fx fy cx cy\n" + numbers_of(camera), 0),
    "six.csv": (lambda camera: numbers_of(camera).replace(" ", ", ") + ", 640, 480\n", 0),
    "lines.txt": (lambda camera: numbers_of(camera).replace(" ", "\n"), 0),
    "columns.json": (lambda camera: json.dumps(columns(camera)), 0),
    "arkit.json": (lambda camera: json.dumps({"intrinsics": columns(camera), "width": 640, "height": 480}), 0),
    "K.npy": (lambda camera: numpy_file(np.save, np.reshape(matrix(camera), (3, 3))), 0),
    "four.npy": (lambda camera: numpy_file(np.save, np.array(numbers_of(camera).split(), float)), 0),
    "calibration.npz": (
        lambda camera: numpy_file(
            np.savez, mtx=np.reshape(matrix(camera), (3, 3)), dist=camera.distortion, rvecs=np.eye(9)
        ),
        5,
    ),
}
"""What writes a camera as other programs do, and how many of its coefficients the format keeps."""

CAMERAS = st.builds(
    lambda fx, fy, cx, cy, k1, others: Intrinsics(fx, fy, cx, cy, *SIZE, (k1, *others)),
    *(st.floats(100, 2000), st.floats(100, 2000), st.floats(1, 639), st.floats(1, 479), st.floats(0.01, 0.2)),
    st.tuples(*[st.floats(-0.2, 0.2)] * 4),
)


@pytest.mark.parametrize("name", FILES)
@given(camera=CAMERAS)
def test_camera_files_of_other_programs_give_their_camera_back(name: str, camera: Intrinsics, tmp_path: Path) -> None:
    write, kept = FILES[name]
    content = write(camera)
    (tmp_path / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    found = read_camera(tmp_path / name, SIZE, "elsewhere/a.jpg")
    assert isinstance(found, Intrinsics)
    centre = (320.0, 240.0) if write is splats else (camera.cx, camera.cy)
    assert (found.fx, found.fy, found.cx, found.cy) == pytest.approx((camera.fx, camera.fy, *centre))
    assert (found.width, found.height) == SIZE
    assert found.distortion == pytest.approx(camera.distortion[:kept], abs=1e-15)


def test_a_matrix_of_opencv_gives_the_camera_with_the_half_pixel() -> None:
    tensor = torch.tensor(D, dtype=torch.float64)
    lenses: list[Any] = [D, np.array(D), np.array(D)[None], np.array(D)[:, None], tensor]
    for lens in (*lenses, list(D)):
        for each in (K, K.tolist(), torch.from_numpy(K), K.ravel(), K.astype(np.float32)):
            assert Intrinsics.from_opencv(each, lens, SIZE) == CAMERA
    assert all(Intrinsics(500.0, 510.0, 311.0, 240.75, *SIZE, lens) == CAMERA for lens in lenses)
    assert Intrinsics.from_opencv(K, np.zeros((5, 1)), np.array(SIZE)) == IDEAL
    assert Intrinsics.from_opencv(K, size=SIZE) == IDEAL
    points = np.random.default_rng(0).uniform([-1, -1, 2], [1, 1, 4], (50, 3))
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, np.array(D))
    pixels = CAMERA.project(torch.from_numpy(points)).numpy() - 0.5  # OpenCV's: the first pixel is (0, 0)
    np.testing.assert_allclose(pixels, expected[:, 0], atol=1e-9)


@pytest.mark.parametrize(
    ("arguments", "found", "expected"),
    [
        ((K[:2], None, SIZE), "K has shape (2, 3)", "3 x 3"),
        ((K.T, None, SIZE), "K is", "(fx 0 cx), (0 fy cy), (0 0 1)"),
        ((K, None, None), "size is None", "(width, height)"),
        ((K, None, (640.5, 480)), "width is 640.5", "whole number"),
        ((K, D[:3], SIZE), "3 coefficients", "0, 4, 5"),
        ((K * np.nan, None, SIZE), "K has values that are NaN", "finite"),
        (("K", None, SIZE), "K is 'K'", "array of numbers"),
        ((np.diag([4.2, 4.2, 1]), None, SIZE), "focal length is 4.2 px", None),
    ],
)
def test_what_is_no_camera_of_opencv(arguments: tuple[Any, ...], found: str, expected: str | None) -> None:
    with refused(found=found, expected=expected):
        Intrinsics.from_opencv(*arguments)


def test_a_bare_matrix_is_refused_with_the_remedy(tmp_path: Path) -> None:
    path: Any = write_photo(tmp_path / "a.png", noise(480, 640))
    for make, image, where in ((Frame.open, path, path), (Frame.from_numpy, noise(480, 640), None)):
        with refused(where=where, found="ndarray", expected="Intrinsics.from_opencv(K, distortion"):
            make(image, camera=K)


def test_focal_lengths_in_millimetres_are_questioned(tmp_path: Path) -> None:
    path = write_photo(tmp_path / "a.png", noise(300, 400))
    with refused(where=path, found="focal length is 4.2 px for an image of 400x300, which would see 178"):
        Frame.open(path, focal=4.2)
    assert Frame.open(path, focal=60.0).intrinsics.fx == 60
    assert Intrinsics.from_focal(4.2, 24, 16).fx == 4.2, "small images have short focal lengths"
    camera = tmp_path / "camera.json"
    camera.write_text(json.dumps({"fl_x": 26, "w": 4000, "h": 3000}))
    with refused(where=camera, found="(2000 to 8000)"):
        Frame.open(path, camera=camera)


@pytest.mark.parametrize("nothing", ["", "~", "null", "[]"])
def test_no_coefficients_are_no_distortion(nothing: str, tmp_path: Path) -> None:
    before, _ = ros_info(CAMERA).split("distortion_coefficients:")
    (tmp_path / "c.yaml").write_text(f"{before}distortion_coefficients: {nothing}\n")
    assert read_camera(tmp_path / "c.yaml", SIZE) == replace(CAMERA, distortion=())


@pytest.mark.parametrize(
    "content",
    [
        ros_info(replace(CAMERA, distortion=D[:4])).replace("plumb_bob", "equidistant").replace("cols: 5", "cols: 4"),
        kalibr(CAMERA).replace("radtan", "equidistant"),
        orb_slam(CAMERA).replace("PinHole", "KannalaBrandt8").replace("p1", "k3").replace("p2", "k4"),
    ],
    ids=["ROS", "Kalibr", "ORB-SLAM"],
)
def test_fisheye_calibrations(content: str, tmp_path: Path) -> None:
    (tmp_path / "c.yaml").write_text(content)
    found = read_camera(tmp_path / "c.yaml", SIZE)
    assert isinstance(found, CentralLens)
    assert (found.stored.fx, found.stored.cx, found.stored.cy) == (500.0, 311.0, 240.75)
    assert found.coefficients[:2] == (0.1, -0.2)


@pytest.mark.parametrize(
    ("content", "found"),
    {
        "a picture": ("<svg><g/></svg>", "is no camera"),
        "b2": (agisoft(CAMERA).replace("</calibration>", "<b2>0.1</b2></calibration>"), "b2 of the lens is 0.1"),
        "k4": (agisoft(CAMERA).replace("</calibration>", "<k4>1e-3</k4></calibration>"), "k4 of the lens is 0.001"),
        "another lens": (agisoft(CAMERA).replace(">frame<", ">equisolid_fisheye<"), "lens is equisolid_fisheye"),
        "words": (agisoft(CAMERA).replace("<cx>", "<cx>nan"), "cx is 'nan-9.0'"),
        "two cameras": (ost(CAMERA) + ost(CAMERA), "a second camera"),
        "no centre": ('{"fx": 500, "fy": 500}', "no cx and cy"),
        "prose": ("my camera has 500 pixels\n", "camera model camera"),
        "another order": ("640 480 500 500 320 240\n", "cx and cy are 500 and 500 for an image of 320x240"),
        "the centre first": ("320 240 500 510\n", "cx and cy are 500 and 510 for an image of 640x480"),
        "half a matrix": ("500 0 320\n0 500 240\n", "line 1 has 3 entries"),
    }.values(),
)
def test_files_of_other_programs_that_hold_no_camera(content: str, found: str, tmp_path: Path) -> None:
    (tmp_path / "c").write_text(content)
    with refused(found=found):
        read_camera(tmp_path / "c", SIZE)


def test_a_list_of_more_cameras_than_any_capture_has_is_refused_before_it_is_parsed(tmp_path: Path) -> None:
    (tmp_path / "list.txt").write_text("a.jpg PINHOLE 64 48 50 50 32 24\n" * 100_001)
    with refused(where=tmp_path / "list.txt", found="100,001 lines", expected="at most 100,000 cameras"):
        read_camera(tmp_path / "list.txt", SIZE, "a.jpg")


def test_the_camera_of_a_photo_is_chosen_by_its_name(tmp_path: Path) -> None:
    (tmp_path / "list.txt").write_text(HLOC.format(camera=IDEAL))
    (tmp_path / "splats.json").write_text(splats(IDEAL, replace(IDEAL, fx=600.0, fy=610.0)))
    assert read_camera(tmp_path / "list.txt", SIZE, "dir/b.jpg") != IDEAL
    for name in ("b.png", "folder/b.png", "b", "C:\\photos\\b.png"):
        found = read_camera(tmp_path / "splats.json", SIZE, name)
        assert isinstance(found, Intrinsics)
        assert found.fx == 600
    for file in (tmp_path / "list.txt", tmp_path / "splats.json"):
        with refused(where=file, found="2 cameras", expected="exactly one, or one named after the photo"):
            read_camera(file, SIZE, "c.jpg")
    for name in ("a", "b"):
        write_photo(tmp_path / f"{name}.png", noise(48, 64))
    queries = Photos([tmp_path / "a.png", tmp_path / "b.png"], DatasetOptions(tmp_path / "splats.json"))
    assert [queries.read(place).frame.intrinsics.fx for place in range(2)] == [50, 60]


def test_a_dataset_whose_frames_state_cameras_is_a_file_of_cameras(tmp_path: Path) -> None:
    """Each photo has the camera of the frame of its name, or else the only one."""
    for name in ("a", "b", "c"):
        write_photo(tmp_path / f"{name}.png", noise(48, 64))
    options, frames = DatasetOptions(tmp_path / "transforms_test.json"), list[dict[str, Any]]()
    photos = Photos([tmp_path / "a.png", tmp_path / "b.png", tmp_path / "c.png"], options)
    for focal, found in ((50.0, [50, 50, 50]), (60.0, [50, 60, None])):
        image = f"images\\test\\{'ab'[len(frames)]}.png"
        frames.append({"file_path": image, "fl_x": focal, "w": 64, "h": 48, "transform_matrix": np.eye(4).tolist()})
        (tmp_path / "transforms_test.json").write_text(json.dumps({"frames": frames}))
        for place, fx in enumerate(found):
            if fx is not None:
                assert photos.read(place).frame.intrinsics.fx == fx
                continue
            with refused(where=options.camera, found="holds 2 cameras", expected="one, or one of a frame named 'c'"):
                photos.read(place)


@pytest.mark.parametrize(
    ("content", "found", "expected"),
    [
        ("a: [1, 2", "is not YAML", None),
        ("just words", None, "YAML of ROS"),
        ("image_width: 640\n", "no camera matrix", None),
        (ros_info(CAMERA).replace("plumb_bob", "double_sphere"), "model double_sphere", "plumb_bob"),
        (ros_info(CAMERA).replace("500.0", "fast"), "fast", "numbers"),
        (ros_info(CAMERA).replace("500.0", "-500.0"), "focal length fx is -500.0", "positive"),
        (kalibr(CAMERA) + kalibr(CAMERA).replace("cam0", "cam1"), "2 cameras", "one"),
        (kalibr(CAMERA).replace("pinhole", "omni"), "camera_model is omni", "pinhole"),
        ("x: !!python/object/apply:os.system ['true']", "no camera matrix", None),
    ],
)
def test_calibrations_that_are_none(content: str, found: str | None, expected: str | None, tmp_path: Path) -> None:
    (tmp_path / "c.yaml").write_text(content)
    with refused(where=tmp_path / "c.yaml", found=found, expected=expected):
        read_camera(tmp_path / "c.yaml", SIZE)


def test_photos_of_equal_names_need_no_depth() -> None:
    photos = [Path("cam0/0001.jpg"), Path("cam1/0001.jpg")]
    assert depth_files(photos, []) == {}
    assert Photos(photos).names == ["cam0_0001", "cam1_0001"]
