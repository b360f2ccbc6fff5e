"""Images and poses exported by RTAB-Map (``rtabmap-export --images --poses_camera``, or its database viewer).

``NAME_rgb/STAMP.jpg`` has ``NAME_depth/STAMP.png`` (16-bit planar z in millimetres, registered) and ``NAME_calib/STAMP.yaml``
(OpenCV's layout); STAMP is the time in seconds, or a number of RTAB-Map's. ``NAME_camera_poses.txt`` or ``NAME_poses.txt`` has
rows of ``timestamp x y z qx qy qz qw`` and perhaps the number (formats 1, 10 and 11), camera to world with OpenCV axes. If
the calibration has a ``local_transform`` (3x4, the camera in the frame of the robot), poses without "camera" in the file's
name are those of the robot, and a remark says so.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

from bidnerf_core.camera import read_camera
from bidnerf_core.datasets import (
    Capture,
    DatasetOptions,
    DepthFile,
    Format,
    Shot,
    first_file,
    numbers_in,
    pose_of_matrix,
    pose_of_numbers,
    warn_about,
)
from bidnerf_core.depth import MILLIMETRE, DepthReader
from bidnerf_core.errors import InputError
from bidnerf_core.frames import photos_in
from bidnerf_core.geometry import SE3
from bidnerf_core.io import parse_yaml, read_file, read_header, read_rows

TRAJECTORY_COLUMNS = "timestamp x y z qx qy qz qw id"


def _read(path: Path, match: tuple[Path, Path], options: DatasetOptions) -> Capture:
    """Read the poses and calibrations. Raises ``InputError`` if one is invalid."""
    folder, file = match
    of_robot, prefix = "camera" not in file.name, folder.name.removesuffix("rgb")
    poses, times = dict[str, SE3 | None](), dict[str, float]()
    for row in read_rows(file, "poses of RTAB-Map", TRAJECTORY_COLUMNS):
        if len(row.words) not in (8, 9):
            raise row.error(f" has {len(row.words)} entries; export the poses in format 11")
        numbers = row.plain_numbers(row.words)
        for key in (row.words[0], row.words[-1]):
            poses[key], times[key] = pose_of_numbers(row.where, numbers[1:8], opengl=False), numbers[0]
    unit, read, shots = options.depth_unit or MILLIMETRE, DepthReader(), list[Shot]()
    for image in photos_in(folder)[0]:
        calibration = first_file(path, f"{prefix}calib/{image.stem}.yaml", f"{prefix}calib.yaml")
        if calibration is None:
            raise InputError("has no calibration", where=image, expected=f"{prefix}calib/{image.stem}.yaml")
        header, depth = read_header(image), first_file(path / f"{prefix}depth", f"{image.stem}.png")
        T_world_camera, T_robot_camera = poses.get(image.stem), _local_transform(calibration) if of_robot else None
        if T_world_camera is not None and T_robot_camera is not None:
            T_world_camera = T_world_camera @ T_robot_camera
        if not shots and T_robot_camera is not None:
            warn_about(
                file, "is taken for poses of the robot, from which those of its camera follow by local_transform"
            )
        shots.append(
            Shot(
                image=image,
                camera=read_camera(calibration, (header.width, header.height)),
                T_world_camera=T_world_camera,
                time=times.get(image.stem),
                depth=None if depth is None else DepthFile(depth, partial(read, depth, unit)),
            )
        )
    expected = "a row with the time or the number of each image"
    return Capture(path, shots, options.colour, "metres", depth_unit=unit, pose_file=file, poses_expected=expected)


def _find(path: Path) -> tuple[Path, Path] | None:
    """Return the folder of the images and the file of the poses, those of the camera before those of the robot."""
    for folder in (folder for folder in sorted(path.glob("*rgb")) if folder.is_dir()):
        prefix = folder.name.removesuffix("rgb")
        poses = first_file(path, f"{prefix}camera_poses.txt", f"{prefix}poses.txt")
        if poses is not None and any(path.glob(f"{prefix}calib*")):
            return folder, poses
    return None


def _local_transform(calibration: Path) -> SE3 | None:
    values = parse_yaml(read_file(calibration, "a calibration"), str(calibration), "a calibration")
    found = values.get("local_transform") if isinstance(values, dict) else None
    if not isinstance(found, dict) or not isinstance(found.get("data"), list):
        return None
    where = f"{calibration}: local_transform"
    return pose_of_matrix(where, numbers_in(where, " ".join(map(str, found["data"])), 12))


reader = Format(
    "RTAB-Map: exported images, depth, calibrations and poses of the camera or the robot",
    "rtabmap_rgb with rtabmap_calib and rtabmap_poses.txt (RTAB-Map)",
    _find,
    _read,
    ["depth_unit"],
    precedence=30,  # a recording with metric poses
)
