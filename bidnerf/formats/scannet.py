"""Scans of ScanNet (http://www.scan-net.org), as its ``SensReader`` exports them.

``color/0.jpg`` is an image, ``depth/0.png`` its depth (16-bit planar z in millimetres, of the depth
camera), and ``pose/0.txt`` its pose (4x4, camera to world, OpenCV axes, metres; -inf if tracking failed).
``intrinsic/intrinsic_color.txt`` and ``intrinsic_depth.txt`` are the 4x4 matrices of the two cameras, whose
principal points are relative to the centre of the upper left pixel, so half a pixel is added. Depth is
registered to the colour camera using these intrinsics, as in 12-Scenes.
"""

from __future__ import annotations

from pathlib import Path

from bidnerf.formats.ace import read_matrix
from bidnerf.formats.layouts import Layout
from bidnerf.formats.twelve_scenes import own_sensor
from bidnerf_core.datasets import Capture, DatasetOptions, Format
from bidnerf_core.depth import MILLIMETRE
from bidnerf_core.io import is_file, read_header

SCANNET = Layout(
    (("color",), ("rgb",)),
    pose=("../pose/{name}.txt",),
    camera=tuple(f"../{folder}intrinsic_color.txt" for folder in ("intrinsic/", "", "intrinsics/")),
    depth=("../depth/{name}.png",),
)


def _read(path: Path, images: list[Path], options: DatasetOptions) -> Capture:
    """Read the cameras and poses. Raises ``InputError`` if one is invalid."""
    calibration, depths = (
        SCANNET.file(SCANNET.camera, images[0]),
        [SCANNET.file(SCANNET.depth, image) for image in images],
    )
    of_depth, first = calibration.with_name("intrinsic_depth.txt"), next(filter(is_file, depths), None)
    camera = read_matrix(calibration, read_header(images[0]).size)
    depth_camera = read_matrix(of_depth, read_header(first).size) if first is not None and is_file(of_depth) else None
    sensor, unit = options.sensor(path, own_sensor(camera, depth_camera)), options.depth_unit or MILLIMETRE
    return Capture(
        path,
        SCANNET.shots(images, camera, unit, sensor),
        options.colour,
        unit="metres",
        depth_unit=unit,
        pose_file=path / "pose",
        poses_expected="NUMBER.txt of finite numbers for each image",
    )


reader = Format(
    "exported ScanNet: depth in millimetres, registered to the colour camera",
    "color/0.jpg with pose/0.txt and intrinsic/intrinsic_color.txt (ScanNet)",
    SCANNET.images,
    _read,
    ("register_depth", "depth_unit"),
    may_lack_poses=True,
    precedence=30,  # a recording with metric poses
)
