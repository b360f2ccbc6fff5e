"""Folders of 12-Scenes (https://graphics.stanford.edu/projects/reloc): an iPad's photos with a Structure sensor's depth.

A scene has ``info.txt`` (``m_calibrationColorIntrinsic`` and ``m_calibrationDepthIntrinsic``, 4x4, of images
of ``m_colorWidth`` x ``m_colorHeight`` and ``m_depthWidth`` x ``m_depthHeight``), ``split.txt`` (``sequence0
[frames=357] [start=0 ; end=356]``) and ``data`` with ``frame-000000.color.jpg``, ``frame-000000.depth.png``
(16-bit planar z in millimetres) and ``frame-000000.pose.txt`` (4x4, camera to world, OpenCV axes, metres;
-INF if tracking failed). Depth is registered to the colour camera using the two calibrations. As in the
relocalization literature (the successors of SCoRe Forests, DSAC, ACE) the first sequence is "test" and the
others are "train"; without ``split.txt`` every eighth frame is held out.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

from bidnerf.formats.seven_scenes import SEVEN_SCENES
from bidnerf_core.camera import CameraSource, Intrinsics
from bidnerf_core.datasets import Capture, DatasetOptions, Format, camera_of, first_file, numbers_in, pixel_size
from bidnerf_core.depth import MILLIMETRE, DepthCamera
from bidnerf_core.errors import InputError
from bidnerf_core.geometry import SE3
from bidnerf_core.io import read_file, read_rows

TWELVE_SCENES = replace(
    SEVEN_SCENES, folders=(("data",), (".",)), camera=("../info.txt", "../_info.txt", "info.txt", "_info.txt")
)


def _read(path: Path, images: list[Path], options: DatasetOptions) -> Capture:
    """Read the poses and splits. Raises ``InputError`` if a metadata file is invalid."""
    own, values = first_file(path, "info.txt", "_info.txt"), dict[str, list[float]]()
    info = own or TWELVE_SCENES.file(TWELVE_SCENES.camera, images[0])
    for row in read_rows(info, "12-Scenes' info.txt", "name = numbers"):
        name, _, text = row.text.partition("=")
        if name.strip().startswith(("m_calibration", "m_color", "m_depth")):
            values[name.strip()] = row.plain_numbers(text.split())
    colour, depth = (_camera(info, values, kind) for kind in ("Color", "Depth"))
    if colour is None:
        raise InputError(
            "no m_calibrationColorIntrinsic", where=info, expected="16 numbers, with m_colorWidth and m_colorHeight"
        )
    unit, sensor = options.depth_unit or MILLIMETRE, options.sensor(path, own_sensor(colour, depth))
    shots = TWELVE_SCENES.shots(images, CameraSource(options.given_camera or colour), unit, sensor)
    if (file := first_file(path, "split.txt", "../split.txt")) is not None:
        text = read_file(file, "a list of sequences").decode("utf-8", "replace")
        first = re.search(r"start\s*=\s*(\d+)\s*;\s*end\s*=\s*(\d+)", text)
        if first is None:
            raise InputError("has no [start=0 ; end=356]", where=file, expected="the frames of each sequence")
        start, end = numbers_in(file, f"{first[1]} {first[2]}", 2)
        in_first = [start <= float(shot.stem.partition("-")[2]) <= end for shot in shots]
        shots = [
            replace(shot, splits=("test" if is_test else "train",)) if shot.T_world_camera else shot
            for shot, is_test in zip(shots, in_first, strict=True)
        ]
    return Capture(
        path,
        shots,
        options.colour,
        unit="metres",
        depth_unit=unit,
        poses_expected="frame-000000.pose.txt of finite numbers",
    )


def own_sensor(colour: Intrinsics, depth: Intrinsics | None) -> DepthCamera | None:
    """Return the depth sensor, or None if it is the colour camera, that is, if their focal lengths agree up to rounding."""
    if depth is None or abs(depth.resized(colour.width, colour.height).fx / colour.fx - 1) < 1e-3:
        return None
    return DepthCamera(depth, SE3.identity())


def _camera(info: Path, values: dict[str, list[float]], kind: str) -> Intrinsics | None:
    matrix = values.get(f"m_calibration{kind}Intrinsic", [])
    size = [values.get(f"m_{kind.lower()}{side}", []) for side in ("Width", "Height")]
    if len(matrix) not in (9, 16) or not all(size):
        return None
    row = 4 if len(matrix) == 16 else 3
    numbers = matrix[0], matrix[row + 1], matrix[2], matrix[row + 2]
    return camera_of(info, numbers, pixel_size(info, [size[0][0], size[1][0]]))


reader = Format(
    "12-Scenes: the first sequence of split.txt is the test, depth registered to the colour camera",
    "info.txt with data/frame-000000.color.jpg ... (12-Scenes)",
    TWELVE_SCENES.images,
    _read,
    ("camera", "register_depth", "depth_unit"),
    precedence=35,  # its images have the names of 7-Scenes' ones
)
