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
from dataclasses import replace
from pathlib import Path

import torch

from bidnerf.formats.layouts import Layout
from bidnerf_core.camera import Intrinsics, folder_camera
from bidnerf_core.datasets import Capture, DatasetOptions, Format, Shot
from bidnerf_core.depth import MILLIMETRE, DepthCamera
from bidnerf_core.errors import InputError
from bidnerf_core.geometry import SE3
from bidnerf_core.io import read_rows

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

SEQUENCE = re.compile(r"seq(?:uence)?-?0*(\d{1,9})", re.IGNORECASE)
SEVEN_SCENES = Layout(
    (("seq*[0-9]",), (".",)),
    image=r"(frame-\d+)\.color\.(?:png|jpe?g)",
    pose=("{name}.pose.txt",),
    depth=("{name}.depth.png",),
)


def _read(path: Path, images: list[Path], options: DatasetOptions) -> Capture:
    """Read the poses and splits. Raises ``InputError`` if any of them is invalid.

    Poses and depth are transferred from the depth sensor to the colour camera, by default with a Kinect's calibration.
    """
    sensor = options.sensor(path, DepthCamera(DEPTH_CAMERA, T_COLOUR_DEPTH))
    camera = folder_camera(path, options.given_camera, DEPTH_CAMERA if sensor is None else COLOUR_CAMERA)
    unit = options.depth_unit or MILLIMETRE
    T_depth_colour = SE3.identity() if sensor is None else sensor.T_colour_depth.inverse()
    number_of = {folder: int("".join(re.findall(r"\d+$", folder.name)) or -1) for folder in {i.parent for i in images}}
    splits = dict[int, tuple[str, ...]]()
    for split, file in (("train", path / "TrainSplit.txt"), ("test", path / "TestSplit.txt")):
        if path in number_of or not file.is_file():
            continue
        rows = read_rows(file, "a list of sequences", "a sequence such as sequence1")
        if not rows:
            raise InputError("lists no sequences", where=file, expected="lines such as sequence1")
        for row in rows:
            match = SEQUENCE.fullmatch(row.text)
            if match is None:
                raise row.error(f": {row.text[:40]!r}")
            number = int(match[1])
            if number not in number_of.values():
                raise InputError(f"no folder for {row.text}", where=row.where, expected=f"seq-{number:02d}")
            splits[number] = *splits.get(number, ()), split
    shots = list[Shot]()
    for image, shot in zip(images, SEVEN_SCENES.shots(images, camera, unit, sensor), strict=True):
        T, own = shot.T_world_camera, splits.get(number_of[image.parent], ())
        if own or not splits:
            shots.append(shot if T is None else replace(shot, T_world_camera=T @ T_depth_colour, splits=own))
    return Capture(
        path,
        shots,
        options.colour,
        unit="metres",
        depth_unit=unit,
        poses_expected="frame-000000.pose.txt",
    )


def _images_of_sequences(path: Path) -> list[Path]:
    """Return the images of the folder or of its sequences, but of no other folder, such as seq-01_old2."""
    images = SEVEN_SCENES.images(path)
    return [image for image in images if image.parent == path or SEQUENCE.fullmatch(image.parent.name)]


reader = Format(
    "7-Scenes: splits of TrainSplit.txt and TestSplit.txt, depth registered to the colour camera",
    "frame-000000.color.png ... in the folder or in seq-01 ... (7-Scenes)",
    _images_of_sequences,
    _read,
    ("camera", "register_depth", "depth_unit"),
    may_lack_poses=True,
    precedence=30,  # a recording with metric poses
)
