"""Images and poses exported by RTAB-Map (``rtabmap-export --images --poses_camera``, or its database viewer).

``NAME_rgb/STAMP.jpg`` has ``NAME_depth/STAMP.png`` (16-bit planar z in millimetres, registered) and ``NAME_calib/STAMP.yaml``
(OpenCV's layout); STAMP is the time in seconds, or a number of RTAB-Map's. ``NAME_camera_poses.txt`` or ``NAME_poses.txt`` has
rows of ``timestamp x y z qx qy qz qw`` and perhaps the number (formats 1, 10 and 11), camera to world with OpenCV axes. If
the calibration has a ``local_transform`` (3x4, the camera in the frame of the robot), poses without "camera" in the file's
name are those of the robot, and a remark says so.
"""

from __future__ import annotations

from pathlib import Path

from bidnerf.formats.layouts import Layout
from bidnerf_core.camera import read_camera
from bidnerf_core.datasets import (
    Capture,
    DatasetOptions,
    Format,
    numbers_in,
    pose_of_matrix,
    pose_of_numbers,
    warn_about,
)
from bidnerf_core.depth import MILLIMETRE
from bidnerf_core.geometry import SE3
from bidnerf_core.io import parse_yaml, read_file, read_rows

RTABMAP = Layout(
    (("*rgb",),),
    image=r"([^.].*)\.\w+",
    pose=("../{prefix}camera_poses.txt", "../{prefix}poses.txt"),
    camera=("../{prefix}calib/{name}.yaml", "../{prefix}calib.yaml"),
    depth=("../{prefix}depth/{name}.png",),
    unmeasured=(),
)


def _read(path: Path, images: list[Path], options: DatasetOptions) -> Capture:
    """Read the poses and calibrations. Raises ``InputError`` if one is invalid."""
    file, unit = RTABMAP.file(RTABMAP.pose, images[0]), options.depth_unit or MILLIMETRE
    poses, times = dict[str, SE3 | None](), dict[str, float]()
    for row in read_rows(file, "poses of RTAB-Map", "timestamp x y z qx qy qz qw id"):
        if len(row.words) not in (8, 9):
            raise row.error(f" has {len(row.words)} entries; export the poses in format 11")
        numbers = row.plain_numbers(row.words)
        for key in (row.words[0], row.words[-1]):
            poses[key], times[key] = pose_of_numbers(row.where, numbers[1:8], opengl=False), numbers[0]
    if "camera" not in file.name:
        mounted = {image.stem: _local_transform(RTABMAP.file(RTABMAP.camera, image)) for image in images}
        poses |= {name: T @ T_robot for name, T_robot in mounted.items() if T_robot and (T := poses.get(name))}
        if any(mounted.values()):
            warn_about(
                file, "is taken for poses of the robot, from which those of its camera follow by local_transform"
            )
    return Capture(
        path,
        RTABMAP.shots(images, read_camera, unit, poses=poses, times=times),
        options.colour,
        "metres",
        depth_unit=unit,
        pose_file=file,
        poses_expected="a row with the time or the number of each image",
    )


def _local_transform(calibration: Path) -> SE3 | None:
    """Return ``T_robot_camera``, or None if the calibration does not state it."""
    values = parse_yaml(read_file(calibration, "a calibration"), str(calibration), "a calibration")
    if (transform := values.get("local_transform")) is None:
        return None
    where = f"{calibration}: local_transform"
    return pose_of_matrix(where, numbers_in(where, transform, 12))


reader = Format(
    "RTAB-Map: exported images, depth, calibrations and poses of the camera or the robot",
    "rtabmap_rgb with rtabmap_calib and rtabmap_poses.txt (RTAB-Map)",
    RTABMAP.images,
    _read,
    ["depth_unit"],
    precedence=30,  # a recording with metric poses
)
