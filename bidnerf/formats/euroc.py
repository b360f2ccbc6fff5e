"""Recordings of EuRoC's micro aerial vehicle, and others in this layout (ASL, TUM-VI): folders with ``mav0``.

``mav0/cam0/data.csv`` lists ``timestamp [ns],filename`` of the images in ``mav0/cam0/data``;
``mav0/cam0/sensor.yaml`` has ``T_BS`` (4x4, camera to body), ``intrinsics`` (fx, fy, cx, cy),
``distortion_coefficients`` and ``resolution``. ``mav0/state_groundtruth_estimate0/data.csv`` (or
``mocap0``, ``vicon0``) has the poses of the body: ``timestamp [ns], px, py, pz, qw, qx, qy, qz``, metres.
Poses are interpolated at the image times and transformed to the camera. Images without a pose are in the
sequence but not in the dataset, and a remark counts them. Principal points are relative to the centre of
the upper left pixel, so half a pixel is added.
"""

from __future__ import annotations

import re
from pathlib import Path

from bidnerf_core.camera import CameraSource
from bidnerf_core.datasets import (
    Capture,
    DatasetOptions,
    Format,
    Shot,
    camera_of,
    first_file,
    numbers_in,
    pose_of_matrix,
    read_timed_files,
    read_trajectory,
)
from bidnerf_core.errors import InputError
from bidnerf_core.geometry import SE3
from bidnerf_core.io import is_file, read_file

TRUTHS = ("state_groundtruth_estimate0", "mocap0", "vicon0", "gt0")


def _read(path: Path, root: Path, options: DatasetOptions) -> Capture:
    """Read the lists. Raises ``InputError`` if one is missing or invalid."""
    truth = first_file(root, *(f"{name}/data.csv" for name in TRUTHS))
    rows = read_timed_files(root / "cam0" / "data.csv")
    camera, T_body_camera = _sensor(root / "cam0" / "sensor.yaml", options)
    trajectory = None if truth is None else read_trajectory(truth)
    shots = list[Shot]()
    for row in rows:
        T_world_body = None if trajectory is None else trajectory.at(row.time)
        pose = None if T_world_body is None else T_world_body @ T_body_camera
        image = root / "cam0" / "data" / row.words[0]
        shots.append(Shot(image=image, camera=camera, T_world_camera=pose, time=row.time))
    expected = f"mav0/{TRUTHS[0]}/data.csv at the times of the images"
    return Capture(path, shots, options.colour, "metres", pose_file=truth, poses_expected=expected)


def _find(path: Path) -> Path | None:
    return next((root for root in (path / "mav0", path) if is_file(root / "cam0" / "data.csv")), None)


def _sensor(file: Path, options: DatasetOptions) -> tuple[CameraSource, SE3]:
    """Return the camera (given or calibrated) and T_body_camera. Raises ``InputError`` for an invalid file."""
    text = read_file(file, "EuRoC's sensor.yaml").decode("utf-8", "replace")
    T_body_camera = pose_of_matrix(file, _numbers(file, text, "T_BS", 16), "the rotation of T_BS")
    if options.given_camera is not None:
        return CameraSource(options.given_camera), T_body_camera
    width, height = _numbers(file, text, "resolution", 2)
    lens = _numbers(file, text, "distortion_coefficients", 4)
    model = re.search(r"distortion_model\s*:\s*([\w-]+)", text)
    if any(lens) and (model is None or model[1] not in ("radial-tangential", "radtan", "plumb_bob")):
        found = "unknown" if model is None else model[1]
        raise InputError(f"distortion_model is {found}", where=file, expected="radial-tangential; undistort the images")
    numbers = _numbers(file, text, "intrinsics", 4)
    return CameraSource(camera_of(file, numbers, (int(width), int(height)), lens)), T_body_camera


def _numbers(file: Path, text: str, key: str, count: int) -> list[float]:
    """Return the ``count`` numbers of a bracketed YAML list, on one or several lines, for ``key``.

    The list may also be the ``data:`` entry of a matrix.
    """
    found = re.search(rf"^\s*{key}\s*:[^\[]*\[([^\]]*)\]", text, re.MULTILINE)
    return numbers_in(f"{file}: {key}", found[1] if found else "", count)


reader = Format(
    "EuRoC and others in the ASL layout: poses of the body, interpolated",
    "mav0/cam0/data.csv with mav0/cam0/sensor.yaml (EuRoC)",
    _find,
    _read,
    ["camera"],
    precedence=30,  # a recording with metric poses
)
