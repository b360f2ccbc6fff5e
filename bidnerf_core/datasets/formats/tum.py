"""Folders of the TUM RGB-D benchmark as it is distributed (https://cvg.cit.tum.de/data/datasets/rgbd-dataset).

``rgb.txt`` and ``depth.txt`` list images with their time stamps (seconds), ``groundtruth.txt`` the poses of
the colour camera in the motion-capture frame: ``timestamp tx ty tz qx qy qz qw``, camera to world, OpenCV
axes. The three files have different times and rates. A colour image is paired with the depth image
nearest in time if they are mutual nearest neighbours at most 20 ms apart, and with the pose interpolated
between the samples before and after it. A frame outside the time span of the ground truth, or in a gap of
more than 0.1 s, has no pose: it is in the sequence but not in the dataset, and a remark counts it. The
ground truth may also be in the format of EuRoC, or of KITTI with one pose for each image. Listed images
that are missing are left out with a remark; names may contain spaces.

Depth is 16-bit planar z in steps of 1/5000 m, 0 where nothing was measured, registered to the colour image.
The published images already include the depth scale correction. Depth of other recordings in this layout is
registered if a sensor is given.

The camera is the first of these that exists: the given one, as a file or as ``freiburg1``, 2 or 3; the one in the folder's
``camera.json`` or ``cameras.txt`` (in the formats of ``bidnerf localize --camera``); the published one of
freiburg1, 2 or 3, according to the folder's name. Published principal points are relative to the centre of
the upper left pixel, so half a pixel is added here. Colour images of freiburg1 and freiburg2 are distorted;
the camera models this (k1 k2 p1 p2 k3), and no image is resampled.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np

from bidnerf_core.camera import Camera, Intrinsics, folder_camera
from bidnerf_core.datasets.capture import Capture, DepthFile, Shot, warn_about
from bidnerf_core.datasets.file_names import FileNames
from bidnerf_core.datasets.reader import DatasetOptions, Format, first_file
from bidnerf_core.datasets.trajectories import (
    LARGEST_GAP,
    POSE,
    TimedRow,
    read_timed_files,
    read_trajectory,
)
from bidnerf_core.depth import DepthReader
from bidnerf_core.errors import amount
from bidnerf_core.io import is_file, read_rows

SENSORS = {
    "1": Intrinsics(517.3, 516.5, 319.1, 255.8, 640, 480, (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    "2": Intrinsics(520.9, 521.0, 325.6, 250.2, 640, 480, (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
    "3": Intrinsics(535.4, 539.2, 320.6, 248.1, 640, 480),
}
"""The benchmark's calibrations of its three colour cameras, not its "ROS default"."""


def _read(path: Path, colour_list: Path, options: DatasetOptions) -> Capture:
    """Read the lists, and associate them by time. Raises ``InputError`` if one is missing or malformed.

    A given camera (intrinsics, a file, or the name of one of the benchmark's sensors) takes precedence over
    all others; depth is registered if a sensor is given.
    """
    names, colours, truth = FileNames(path), read_timed_files(colour_list), path / "groundtruth.txt"
    times = [row.time for row in colours]
    has_poses = truth.is_file() and read_rows(truth, "a trajectory", POSE)  # a header alone is as good as no file
    trajectory = read_trajectory(truth, times) if has_poses else None
    given: Camera | Path | None = options.given_camera
    if isinstance(given, Path) and not given.exists():
        given = _published_camera(str(given), whole=True) or given
    sensors = "freiburg1, freiburg2 and freiburg3"
    unknown, ways = f"its name contains none of {sensors}", f"one of {sensors}, or a file"
    published = _published_camera(path.resolve().name)
    camera = folder_camera(path, given, published, unknown, ways, trajectory is not None)
    sensor, unit = options.sensor(path), options.depth_unit or 1 / 5000
    depth_list, read_depth = path / "depth.txt", DepthReader(documented=("65535",))
    images = [_file(row, names) for row in colours]
    measured = [(row.time, _file(row, names)) for row in read_timed_files(depth_list)] if is_file(depth_list) else []
    depths = [(time, file) for time, file in measured if is_file(file)]
    if lost := len(measured) - len(depths):
        warn_about(depth_list, f"{lost} of {amount(len(measured), 'depth image')} are missing and left out")
    # Only existing files are associated: an image whose nearest depth image is missing may belong to the next one.
    there = [index for index, image in enumerate(images) if is_file(image)]
    partners = associate([times[index] for index in there], [time for time, _ in depths], 0.02)  # as in the benchmark
    depth_of = {there[index]: depths[other][1] for index, other in partners.items()}
    shots = list[Shot]()
    for index, (time, image) in enumerate(zip(times, images, strict=True)):
        depth = depth_of.get(index)
        shots.append(
            Shot(
                image=image,
                camera=camera,
                T_world_camera=None if trajectory is None else trajectory.at(time),
                time=time,
                depth=None if depth is None else DepthFile(depth, partial(read_depth, depth, unit), sensor),
            )
        )
    return Capture(
        path,
        shots,
        options.colour,
        unit="metres",
        depth_unit=unit,
        pose_file=truth,
        poses_expected="the poses of the frames of a dataset"
        if trajectory is None
        else f"samples before and after the times of images, at most {LARGEST_GAP:g} s apart",
        unposed=f"before its first pose, after its last, or in gaps of more than {LARGEST_GAP:g} s",
    )


def _published_camera(name: str, whole: bool = False) -> Intrinsics | None:
    """Return the benchmark's calibration of the sensor that ``name`` contains (or is, with ``whole``), or None."""
    sensor = re.compile(r"(?:freiburg|fr)_?([123])(?!\d)", re.IGNORECASE)
    match = sensor.fullmatch(name) if whole else sensor.search(name)
    return SENSORS[match[1]] if match else None


def _file(row: TimedRow, names: FileNames) -> Path:
    """Return the path of the file listed in a row. Its name may contain spaces, and the file may not exist."""
    return names.find(row.rest.strip("\"'")) or names.path(row.words[0])


def associate(times: Sequence[float], others: Sequence[float], largest: float) -> dict[int, int]:
    """Return the pairs of indices that are mutual nearest neighbours in time, at most ``largest`` seconds apart.

    Both lists are in chronological order.
    """
    if not len(times) or not len(others):
        return {}
    ours, theirs = np.array(times), np.array(others)
    # A time is nearest to the other time whose interval, bounded by the midpoints to its neighbours, contains it.
    forth = np.searchsorted((theirs[1:] + theirs[:-1]) / 2, ours)
    back = np.searchsorted((ours[1:] + ours[:-1]) / 2, theirs)
    is_pair = (back[forth] == np.arange(len(ours))) & (np.abs(ours - theirs[forth]) <= largest)
    return {int(index): int(forth[index]) for index in np.flatnonzero(is_pair)}


reader = Format(
    "TUM RGB-D: poses interpolated, depth nearest in time, in steps of 1/5000 m",
    "rgb.txt with depth.txt and groundtruth.txt (TUM RGB-D)",
    lambda path: first_file(path, "rgb.txt"),
    _read,
    ("camera", "register_depth", "depth_unit"),
    may_lack_poses=True,
    precedence=40,  # recordings of other formats get these lists for SLAM programs
)
