"""Folders of 7-Scenes (https://www.microsoft.com/en-us/research/project/rgb-d-dataset-7-scenes).

A frame is ``frame-000000.color.png``, ``frame-000000.depth.png`` (16-bit planar z in millimetres, 0 and 65535
where nothing was measured) and ``frame-000000.pose.txt`` (4x4, camera to world, OpenCV axes, metres). A scene
has folders ``seq-01``, ``seq-02`` ..., and the files ``TrainSplit.txt`` and ``TestSplit.txt`` list them
("sequence1" or "seq-01"). The folder of a single sequence can be read as well; in that case, and in a scene
without split files, every eighth frame (the first, the ninth ...) is held out as "test" and the others are
"train". The format records no times: a sequence is ordered by folder and number.

The Kinect's two cameras were not calibrated, and its depth is not registered to its colour images. The poses
are those of the depth camera (focal length 585 px); the colour camera has 525 px and is mounted 2.6 cm away.
By default, poses and depth are handled as in the literature (ACE, CVPR 2023, and the pseudo ground truth
of Brachmann et al., ICCV 2021): poses are transformed to the colour camera and depth is registered to it,
using the calibration of another Kinect or a given one. Without registration, images, depth and poses are used
as they are, with the 585 px stated on the dataset's page for both cameras, as in KinectFusion and others;
near the image border, colours are then some 30 px away from their depth.

Cameras are scaled to images of other sizes. A camera that is given, or found in the folder's ``camera.json``
or ``cameras.txt``, describes the colour images; without registration, it describes the depth images as well.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import torch

from bidnerf_core.camera import CameraSource, Intrinsics, folder_camera
from bidnerf_core.datasets import Capture, DatasetOptions, DepthFile, Format, Shot, read_pose_matrix
from bidnerf_core.depth import MILLIMETRE, DepthCamera, DepthImage, DepthReader
from bidnerf_core.errors import InputError
from bidnerf_core.frames import natural_order
from bidnerf_core.geometry import SE3
from bidnerf_core.io import is_file, read_rows

DEPTH_CAMERA = Intrinsics(585, 585, 320, 240, 640, 480)
COLOUR_CAMERA = Intrinsics(525, 525, 320, 240, 640, 480)
T_COLOUR_DEPTH = SE3(
    torch.tensor(
        [
            [9.9996518012567637e-01, 2.6765126468950343e-03, -7.9041012313000904e-03],
            [-2.7409311281316700e-03, 9.9996302803027592e-01, -8.1504520778013286e-03],
            [7.8819942130445332e-03, 8.1718328771890631e-03, 9.9993554558014031e-01],
        ],
        dtype=torch.float64,
    ),
    torch.tensor([-2.5558943178152542e-02, 1.0109636268061706e-04, 2.0318321729487039e-03], dtype=torch.float64),
).normalized()
"""Pose of another Kinect's depth camera in its colour camera's frame, as used by ACE's ``setup_7scenes.py``:
https://projet.liris.cnrs.fr/voir/activities-dataset/kinect-calibration.html."""

SEQUENCE = re.compile(r"seq(?:uence)?-?0*(\d+)", re.IGNORECASE)


def _read(path: Path, folders: dict[int, Path], options: DatasetOptions) -> Capture:
    """Read the poses and splits. Raises ``InputError`` if any of them is invalid.

    Poses and depth are transferred from the depth sensor to the colour camera, by default with a Kinect's calibration.
    """
    sensor = options.sensor(path, DepthCamera(DEPTH_CAMERA, T_COLOUR_DEPTH))
    camera = folder_camera(path, options.given_camera, DEPTH_CAMERA if sensor is None else COLOUR_CAMERA)
    unit, read_depth = options.depth_unit or MILLIMETRE, DepthReader(documented=("65535",))
    T_depth_colour = SE3.identity() if sensor is None else sensor.T_colour_depth.inverse()
    lists = {"train": path / "TrainSplit.txt", "test": path / "TestSplit.txt"}
    numbers = {
        split: _read_split(file, folders) for split, file in lists.items() if -1 not in folders and file.is_file()
    }
    shots = list[Shot]()
    for number in dict.fromkeys(n for group in numbers.values() for n in group) or sorted(folders):
        splits = tuple(split for split, group in numbers.items() if number in group)
        for shot in frames_of(folders[number], camera, partial(read_depth, unit=unit), sensor):
            T = shot.T_world_camera
            shots.append(shot if T is None else replace(shot, T_world_camera=T @ T_depth_colour, splits=splits))
    return Capture(
        path,
        shots,
        options.colour,
        unit="metres",
        depth_unit=unit,
        poses_expected="frame-000000.pose.txt",
    )


def _find(path: Path) -> dict[int, Path]:
    """Return the sequence folders by number; if ``path`` is itself a sequence, its number is -1."""
    found = {child: SEQUENCE.fullmatch(child.name) for child in path.glob("seq*") if child.is_dir()}
    folders = {int(match[1]): child for child, match in found.items() if match}
    if any(map(images_of, folders.values())):
        return folders
    return {-1: path} if images_of(path) else {}


def images_of(folder: Path) -> list[Path]:
    """Return the colour images of a folder in the order of their numbers."""
    name = re.compile(r"frame-\d+\.color\.(?:png|jpe?g)", re.IGNORECASE)
    found = [file for file in folder.glob("frame-*") if name.fullmatch(file.name)]
    return sorted(found, key=lambda file: natural_order(file.name))


def frames_of(
    folder: Path, camera: CameraSource, read_depth: Callable[[Path], DepthImage], sensor: DepthCamera | None
) -> list[Shot]:
    """Return the frames of a folder with their poses as stored. Raises ``InputError`` if there are no frames."""
    images, shots = images_of(folder), list[Shot]()
    if not images:
        raise InputError("has no frames", where=folder, expected="frame-000000.color.png ...")
    for image in images:
        stem = image.name.partition(".")[0]
        depth, pose = (folder / f"{stem}.{kind}" for kind in ("depth.png", "pose.txt"))
        measured = DepthFile(depth, partial(read_depth, depth), sensor) if is_file(depth) else None
        T = read_pose_matrix(pose)
        shots.append(Shot(image=image, stem=stem, camera=camera, T_world_camera=T, depth=measured))
    return shots


def _read_split(file: Path, folders: dict[int, Path]) -> list[int]:
    """Return the numbers of the sequences in a split file. Raises ``InputError`` if it lists none or an unknown one."""
    numbers = list[int]()
    for row in read_rows(file, "a list of sequences", "a sequence such as sequence1"):
        found = SEQUENCE.fullmatch(row.text)
        if found is None:
            raise row.error(f": {row.text[:40]!r}")
        number = int(found[1])
        if number not in folders:
            raise InputError(f"no folder for {row.text}", where=row.where, expected=f"seq-{number:02d}")
        numbers.append(number)
    if not numbers:
        raise InputError("lists no sequences", where=file, expected="lines such as sequence1")
    return numbers


reader = Format(
    "7-Scenes: splits of TrainSplit.txt and TestSplit.txt, depth registered to the colour camera",
    "frame-000000.color.png ... in the folder or in seq-01 ... (7-Scenes)",
    _find,
    _read,
    ("camera", "register_depth", "depth_unit"),
    may_lack_poses=True,
    precedence=30,  # a recording with metric poses
)
