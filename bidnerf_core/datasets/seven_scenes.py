"""Folders of 7-Scenes (https://www.microsoft.com/en-us/research/project/rgb-d-dataset-7-scenes).

A frame is ``frame-000000.color.png``, ``frame-000000.depth.png`` (16-bit planar z in millimetres, 0 and 65535
where nothing was measured) and ``frame-000000.pose.txt`` (4x4, camera to world, OpenCV axes, metres). A scene
has folders ``seq-01``, ``seq-02`` ..., and the files ``TrainSplit.txt`` and ``TestSplit.txt`` list them
("sequence1" or "seq-01"). The folder of a single sequence can be read as well; in that case, and in a scene
without split files, every eighth frame (the first, the ninth ...) is held out as "test" and the others are
"train". The format records no times: a sequence is ordered by folder and number.

The Kinect's two cameras were not calibrated, and its depth is not registered to its colour images. The poses
are those of the depth camera (focal length 585 px); the colour camera has 525 px and is mounted 2.6 cm away.
By default both are handled as in the relocalization literature (ACE, CVPR 2023, and the pseudo ground truth
of Brachmann et al., ICCV 2021): poses are transformed to the colour camera and depth is registered to it,
using the calibration of another Kinect or a given one. Without registration, images, depth and poses are used
as they are, with the 585 px stated on the dataset's page for both, as in KinectFusion and its successors;
near the image border, colours are then some 30 px away from their depth.

Cameras are scaled to images of other sizes. A camera that is given, or found in the folder's ``camera.json``
or ``cameras.txt``, describes the colour images; without registration, it describes the depth images as well.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import torch

from bidnerf_core.camera import CameraSource, Intrinsics, folder_camera
from bidnerf_core.datasets.dataset import Dataset
from bidnerf_core.datasets.incomplete import present
from bidnerf_core.datasets.pose_rows import read_pose_matrix
from bidnerf_core.datasets.reader import Reader, ReadOptions
from bidnerf_core.datasets.rgbd import DepthFile, read_rgbd
from bidnerf_core.datasets.sequence import FrameSequence
from bidnerf_core.datasets.splits import SplitDataset, Splits, hold_out
from bidnerf_core.depth import MILLIMETRE, DepthCamera, DepthReader
from bidnerf_core.errors import InputError
from bidnerf_core.frames import Frame, natural_order
from bidnerf_core.geometry import SE3, LengthUnit
from bidnerf_core.io import Background, read_rows

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
    torch.tensor(
        [-2.5558943178152542e-02, 1.0109636268061706e-04, 2.0318321729487039e-03], dtype=torch.float64
    ),
).normalized()
"""https://projet.liris.cnrs.fr/voir/activities-dataset/kinect-calibration.html, as used by ACE's ``setup_7scenes.py``."""
SEVEN_SCENES_KINECT = DepthCamera(DEPTH_CAMERA, T_COLOUR_DEPTH)

COLOUR = re.compile(r"(frame-\d+)\.color\.(?:png|jpe?g)", re.IGNORECASE)
SEQUENCE = re.compile(r"seq(?:uence)?-?0*(\d+)", re.IGNORECASE)
SPLIT_FILES = {"train": "TrainSplit.txt", "test": "TestSplit.txt"}


@dataclass(frozen=True, eq=False)
class SceneFrame:
    """A colour image, and the paths of the files that may accompany it."""

    image: Path

    time = None

    @property
    def stem(self) -> str:
        return self.image.name.partition(".")[0]

    @property
    def parts(self) -> tuple[str, ...]:
        return (*self.image.parts[:-1], self.stem)

    @property
    def depth(self) -> Path:
        return self.image.with_name(f"{self.stem}.depth.png")

    @property
    def pose(self) -> Path:
        return self.image.with_name(f"{self.stem}.pose.txt")


class SevenScenesReader(Reader):
    """Reader for 7-Scenes folders.

    Poses and depth are transferred from the depth sensor to the colour camera, by default with a Kinect's
    calibration.
    """

    accepts = ("camera", "register_depth", "depth_unit")
    expected = "frame-000000.color.png ... in the folder or in seq-01 ... (7-Scenes)"

    def recognises(self, path: Path) -> bool:
        return any(_has_frames(folder) for folder in (path, *_sequence_folders(path).values()))

    def open(self, path: Path, options: ReadOptions) -> Dataset:
        """List the frames; those without a pose are left out and counted.

        Raises ``InputError`` if none has a pose, and for invalid split files.
        """
        splits = _splits(path)
        frames = list({frame: None for group in splits.values() for frame in group})
        posed = set(
            present(
                frames,
                lambda frame: frame.pose.is_file(),
                path,
                lambda frame: frame.pose.relative_to(path),
                lambda frame: InputError(
                    f"no such file, although {frame.image.name} exists", where=frame.pose
                ),
                noun="pose",
            )
        )
        kept = {split: [frame for frame in group if frame in posed] for split, group in splits.items()}
        return self._dataset(path, {split: group for split, group in kept.items() if group}, options)

    def open_sequence(self, path: Path, options: ReadOptions) -> FrameSequence:
        """List the frames, including those without a pose."""
        splits = _splits(path)
        posed = {split: [frame for frame in group if frame.pose.is_file()] for split, group in splits.items()}
        unposed = {frame: None for group in splits.values() for frame in group if not frame.pose.is_file()}
        return self._dataset(path, {s: g for s, g in posed.items() if g}, options).sequence(list(unposed))

    def _dataset(
        self, path: Path, splits: dict[str, list[SceneFrame]], options: ReadOptions
    ) -> SevenScenesDataset:
        sensor = options.sensor(path, SEVEN_SCENES_KINECT)
        camera = folder_camera(path, options.camera, DEPTH_CAMERA if sensor is None else COLOUR_CAMERA)
        unit = MILLIMETRE if options.depth_unit is None else options.depth_unit
        return SevenScenesDataset(Splits(path, splits), camera, sensor, options.background, unit)


class SevenScenesDataset(SplitDataset[SceneFrame]):
    """Views of a folder of 7-Scenes; see ``Dataset``."""

    unit: LengthUnit | None = "metres"

    def __init__(
        self,
        frames: Splits[SceneFrame],
        camera: CameraSource,
        sensor: DepthCamera | None,
        background: Background | None,
        depth_unit: float,
    ) -> None:
        super().__init__(frames, background)
        self._camera, self._sensor = camera, sensor
        self.depth_unit = self._metres_per_step = depth_unit
        self._read_depth = DepthReader(documented=("65535",))

    def _pose(self, frame: SceneFrame) -> SE3 | None:
        if not frame.pose.is_file():
            return None
        T_world_depth = read_pose_matrix(frame.pose)
        return (
            T_world_depth if self._sensor is None else T_world_depth @ self._sensor.T_colour_depth.inverse()
        )

    def _frame(self, frame: SceneFrame, name: str) -> Frame:
        depth = None
        if frame.depth.is_file():
            depth = DepthFile(frame.depth, self._metres_per_step, self._read_depth, self._sensor)
        return read_rgbd(name, frame.image, self._camera.at(frame.image), self._background, depth)


def _splits(path: Path) -> dict[str, list[SceneFrame]]:
    """Return the frames of the listed sequences; without split files, of all sequences with every eighth
    frame held out.
    """
    folders = _sequence_folders(path)
    listed = {split: path / name for split, name in SPLIT_FILES.items() if (path / name).is_file()}
    if not folders:
        return hold_out(_frames(path))
    if not listed:
        return hold_out([frame for number in sorted(folders) for frame in _frames(folders[number])])
    numbers = {split: _listed(file, folders) for split, file in listed.items()}
    frames = {number: _frames(folders[number]) for number in {n for group in numbers.values() for n in group}}
    return {split: [frame for n in group for frame in frames[n]] for split, group in numbers.items()}


def _listed(file: Path, folders: dict[int, Path]) -> list[int]:
    """Return the numbers of the sequences that a split file lists. Raises ``InputError``."""
    numbers = list[int]()
    for row in read_rows(file, "a list of sequences", "a sequence such as sequence1"):
        found = SEQUENCE.fullmatch(row.text)
        if found is None:
            raise row.error(f": {row.text[:40]!r}")
        if int(found[1]) not in folders:
            raise InputError(
                f"no folder for {row.text}", where=row.where, expected=f"seq-{int(found[1]):02d}"
            )
        if int(found[1]) in numbers:
            raise InputError(f"{row.text} is repeated", where=row.where, expected="each sequence once")
        numbers.append(int(found[1]))
    if not numbers:
        raise InputError("lists no sequences", where=file, expected="lines such as sequence1")
    return numbers


def _frames(folder: Path) -> list[SceneFrame]:
    frames = [SceneFrame(file) for file in folder.iterdir() if COLOUR.fullmatch(file.name)]
    if not frames:
        raise InputError("has no frames", where=folder, expected="frame-000000.color.png ...")
    return sorted(frames, key=lambda frame: natural_order(frame.image.name))


def _sequence_folders(path: Path) -> dict[int, Path]:
    found = {child: SEQUENCE.fullmatch(child.name) for child in path.glob("seq*") if child.is_dir()}
    return {int(match[1]): child for child, match in found.items() if match}


def _has_frames(folder: Path) -> bool:
    return any(COLOUR.fullmatch(file.name) for file in folder.glob("frame-*"))


reader = SevenScenesReader()
