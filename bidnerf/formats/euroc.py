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
    pixel_size,
    pose_of_matrix,
    read_timed_files,
    read_trajectory,
)
from bidnerf_core.errors import InputError
from bidnerf_core.geometry import SE3
from bidnerf_core.io import is_file, parse_yaml, read_file

TRUTHS = ("state_groundtruth_estimate0", "mocap0", "vicon0", "gt0")
EXPECTED_SENSOR = "EuRoC's sensor.yaml"


def _read(path: Path, root: Path, options: DatasetOptions) -> Capture:
    """Read the lists. Raises ``InputError`` if one is missing or invalid."""
    truth = first_file(root, *(f"{name}/data.csv" for name in TRUTHS))
    rows = read_timed_files(root / "cam0" / "data.csv", nanoseconds=True)
    camera, T_body_camera = _sensor(root / "cam0" / "sensor.yaml", options)
    trajectory = None if truth is None else read_trajectory(truth)
    shots = list[Shot]()
    for row in rows:
        T_world_body = None if trajectory is None else trajectory.at(row.time)
        pose = None if T_world_body is None else T_world_body @ T_body_camera
        shots.append(
            Shot(image=root / "cam0" / "data" / row.words[0], camera=camera, T_world_camera=pose, time=row.time)
        )
    return Capture(
        path,
        shots,
        options.colour,
        "metres",
        pose_file=truth,
        poses_expected=f"mav0/{TRUTHS[0]}/data.csv at the times of the images",
    )


def _sensor(file: Path, options: DatasetOptions) -> tuple[CameraSource, SE3]:
    """Return the camera (given or calibrated) and T_body_camera. Raises ``InputError`` for an invalid file."""
    values = parse_yaml(read_file(file, EXPECTED_SENSOR), str(file), EXPECTED_SENSOR)

    def numbers(key: str, count: int) -> list[float]:
        return numbers_in(f"{file}: {key}", values.get(key), count)

    T_body_camera = pose_of_matrix(file, numbers("T_BS", 16), "the rotation of T_BS")
    if options.given_camera is not None:
        return CameraSource(options.given_camera), T_body_camera
    size = pixel_size(file, numbers("resolution", 2))
    lens, model = numbers("distortion_coefficients", 4), values.get("distortion_model", "unknown")
    if any(lens) and model not in ("radial-tangential", "radtan", "plumb_bob"):
        raise InputError(f"distortion_model is {model}", where=file, expected="radial-tangential; undistort the images")
    return CameraSource(camera_of(file, numbers("intrinsics", 4), size, lens)), T_body_camera


reader = Format(
    "EuRoC and others in the ASL layout: poses of the body, interpolated",
    "mav0/cam0/data.csv with mav0/cam0/sensor.yaml (EuRoC)",
    lambda path: next((root for root in (path / "mav0", path) if is_file(root / "cam0" / "data.csv")), None),
    _read,
    ["camera"],
    may_lack_poses=True,
    precedence=30,  # a recording with metric poses
)
