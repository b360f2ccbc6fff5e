"""Folders of the TUM RGB-D benchmark as it is distributed (https://cvg.cit.tum.de/data/datasets/rgbd-dataset).

``rgb.txt`` and ``depth.txt`` list images with their time stamps (seconds), ``groundtruth.txt`` the poses of
the colour camera in the motion-capture frame: ``timestamp tx ty tz qx qy qz qw``, camera to world, OpenCV
axes. The three are sampled at different times and rates. A colour image is paired with the depth image
nearest in time if they are mutual nearest neighbours at most 20 ms apart, and with the pose interpolated
between the samples before and after it. A frame outside the time span of the ground truth, or in a gap of
more than 0.1 s, has no pose: it is in the sequence but not in the dataset, and a remark counts it. The ground
truth may also be in the format of EuRoC, or of KITTI with one pose for each image. Every eighth posed frame
(the first, the ninth ...) is held out as "test" and the others are "train". Listed images that are missing
are left out with a remark; names may contain spaces.

Depth is 16-bit planar z in steps of 1/5000 m, 0 where nothing was measured, registered to the colour image.
The published images already include the depth scale correction. Depth of other recordings in this layout is
registered if a sensor is given.

The camera is, in this order: the given one, as a file or as ``freiburg1``, 2 or 3; the one in the folder's
``camera.json`` or ``cameras.txt`` (in the formats of ``bidnerf localize --camera``); the published one of
freiburg1, 2 or 3, according to the folder's name. Published principal points are relative to the centre of
the upper left pixel, so half a pixel is added here. Colour images of freiburg1 and freiburg2 are distorted;
the camera models this (k1 k2 p1 p2 k3), and no image is resampled.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bidnerf_core.camera import Camera, CameraSource, Intrinsics, folder_camera
from bidnerf_core.datasets.dataset import Dataset
from bidnerf_core.datasets.file_names import FileNames, posix_name
from bidnerf_core.datasets.incomplete import present, remark
from bidnerf_core.datasets.reader import Reader, ReadOptions
from bidnerf_core.datasets.rgbd import DepthFile, read_rgbd
from bidnerf_core.datasets.sequence import FrameSequence
from bidnerf_core.datasets.splits import SplitDataset, Splits, hold_out
from bidnerf_core.datasets.trajectories import (
    LARGEST_GAP,
    TimedRow,
    Trajectory,
    read_timed_rows,
    read_trajectory,
    require_distinct_times,
)
from bidnerf_core.depth import DepthCamera, DepthReader
from bidnerf_core.errors import InputError
from bidnerf_core.frames import Frame
from bidnerf_core.geometry import SE3, LengthUnit
from bidnerf_core.io import Background

COLOUR_LIST, DEPTHS, TRUTH = "rgb.txt", "depth.txt", "groundtruth.txt"
METRES_PER_STEP = 1 / 5000
LARGEST_DIFFERENCE = 0.02
"""Maximum time (seconds) between a colour image and its depth image, as in the benchmark's own association."""
CAMERAS = {
    "1": Intrinsics(517.3, 516.5, 319.1, 255.8, 640, 480, (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    "2": Intrinsics(520.9, 521.0, 325.6, 250.2, 640, 480, (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
    "3": Intrinsics(535.4, 539.2, 320.6, 248.1, 640, 480),
}
"""The benchmark's calibrations of its three colour cameras, not its "ROS default"."""
SENSORS = "freiburg1, freiburg2 and freiburg3"
SENSOR = re.compile(r"(?:freiburg|fr)_?([123])(?!\d)", re.IGNORECASE)


@dataclass(frozen=True)
class ListedDepth:
    """A listed depth image."""

    where: str
    image: Path
    is_there: bool


@dataclass(frozen=True, eq=False)
class TumFrame:
    """A listed colour image, with its associated data."""

    where: str  # the file and line that lists it
    image: Path
    time: float
    depth: ListedDepth | None
    truth: SE3 | None  # T_world_camera
    is_there: bool  # whether the image file exists

    @property
    def stem(self) -> str:
        return self.image.stem

    @property
    def parts(self) -> tuple[str, ...]:
        return (*self.image.parts[:-1], self.stem)


class TumReader(Reader):
    """Reader for folders of the TUM RGB-D benchmark.

    A given camera (intrinsics, a file, or the name of one of the benchmark's sensors) takes precedence over
    all others; depth is registered if a sensor is given.
    """

    accepts = ("camera", "register_depth", "depth_unit")
    expected = "rgb.txt with depth.txt and groundtruth.txt (TUM RGB-D)"

    def recognises(self, path: Path) -> bool:
        return (path / COLOUR_LIST).is_file()

    def open(self, path: Path, options: ReadOptions) -> Dataset:
        """Read the lists. Raises ``InputError`` if one is missing or malformed, and if no frame has a pose."""
        if not (path / TRUTH).is_file():
            raise InputError(
                "no such file", where=path / TRUTH, expected="the poses of the frames of a dataset"
            )
        frames, trajectory = _recorded(path)
        posed = [frame for frame in frames if frame.truth is not None]
        if trajectory is not None and len(posed) < len(frames):
            _remark_without_pose(path, len(frames), len(posed), trajectory)
        return self._dataset(path, hold_out(posed), options)

    def open_sequence(self, path: Path, options: ReadOptions) -> FrameSequence:
        """Read the lists; the sequence includes frames without a pose, and has only these if there is no ground truth."""
        frames = tum_frames(path)
        posed = [frame for frame in frames if frame.truth is not None]
        unposed = [frame for frame in frames if frame.truth is None]
        splits = hold_out(posed) if posed else {}
        return self._dataset(path, splits, options).sequence(unposed)

    def _dataset(self, path: Path, splits: dict[str, list[TumFrame]], options: ReadOptions) -> TumDataset:
        given = None if options.camera is None else _named_camera(options.camera) or options.camera
        unknown, ways = f"its name contains none of {SENSORS}", f"one of {SENSORS}, or a file"
        camera = folder_camera(path, given, published_camera(path), unknown, ways)
        unit = METRES_PER_STEP if options.depth_unit is None else options.depth_unit
        return TumDataset(Splits(path, splits), camera, options.sensor(path), options.background, unit)


class TumDataset(SplitDataset[TumFrame]):
    """Views of a folder of the TUM RGB-D benchmark; see ``Dataset``."""

    unit: LengthUnit | None = "metres"

    def __init__(
        self,
        frames: Splits[TumFrame],
        camera: CameraSource,
        sensor: DepthCamera | None,
        background: Background | None,
        depth_unit: float,
    ) -> None:
        super().__init__(frames, background)
        self._camera, self._sensor = camera, sensor
        self.depth_unit = self._metres_per_step = depth_unit
        self._read_depth = DepthReader(documented=("65535",))

    def _frame(self, frame: TumFrame, name: str) -> Frame:
        depth = None
        if frame.depth is not None:
            depth = DepthFile(frame.depth.image, self._metres_per_step, self._read_depth, self._sensor)
        return read_rgbd(name, frame.image, self._camera.at(frame.image), self._background, depth)

    def _pose(self, frame: TumFrame) -> SE3 | None:
        return frame.truth


def published_camera(folder: Path) -> Intrinsics | None:
    """Return the benchmark's calibration of the sensor in the folder's name, or None."""
    found = SENSOR.search(folder.resolve().name)
    return CAMERAS[found[1]] if found else None


def _named_camera(given: Camera | Path) -> Intrinsics | None:
    """Return the calibration of a sensor given by name, such as ``freiburg1``, or None."""
    found = None if not isinstance(given, Path) or given.exists() else SENSOR.fullmatch(str(given))
    return CAMERAS[found[1]] if found else None


def tum_frames(folder: Path) -> list[TumFrame]:
    """Read the lists of a folder and associate them by time; no image is opened. Raises ``InputError``.

    Missing images are left out, and remarks count them.
    """
    return _recorded(folder)[0]


def _recorded(folder: Path) -> tuple[list[TumFrame], Trajectory | None]:
    """Return the frames of a folder, and its ground truth if it has one."""
    names = FileNames(folder)
    colours = _listed(folder / COLOUR_LIST)
    times = [row.time for row in colours]
    path = read_trajectory(folder / TRUTH, times) if (folder / TRUTH).is_file() else None
    depths = _depths(folder, names)
    partners = associate(times, [time for time, _ in depths], LARGEST_DIFFERENCE)
    frames = [
        _frame(row, names, folder, path, depths[partners[place]][1] if place in partners else None)
        for place, row in enumerate(colours)
    ]
    there = present(
        frames,
        lambda frame: frame.is_there,
        folder / COLOUR_LIST,
        lambda frame: frame.image.relative_to(folder),
        lambda frame: InputError(f"no image {frame.image}", where=frame.where, expected="that file"),
    )
    return there, path


def _frame(
    row: TimedRow, names: FileNames, folder: Path, path: Trajectory | None, depth: ListedDepth | None
) -> TumFrame:
    image, is_there = _file(row, names, folder)
    return TumFrame(row.where, image, row.time, depth, None if path is None else path.at(row.time), is_there)


def _depths(folder: Path, names: FileNames) -> list[tuple[float, ListedDepth]]:
    """Return the times and files of the depth images that exist."""
    if not (folder / DEPTHS).is_file():
        return []
    listed = [
        (row.time, ListedDepth(row.where, *_file(row, names, folder))) for row in _listed(folder / DEPTHS)
    ]
    return present(
        listed,
        lambda entry: entry[1].is_there,
        folder / DEPTHS,
        lambda entry: entry[1].image.relative_to(folder),
        noun="depth image",
    )


def _file(row: TimedRow, names: FileNames, folder: Path) -> tuple[Path, bool]:
    """Return the file that a row lists, whose name may contain spaces, and whether it exists."""
    for name in (row.rest.strip("\"'"), row.words[0]):
        if (found := names.find(posix_name(name))) is not None:
            return found, True
    return folder / row.words[0], False


def _remark_without_pose(path: Path, images: int, posed: int, trajectory: Trajectory) -> None:
    """Count the images without a pose, and report the usual gap between poses. Raises ``InputError`` if no
    image has a pose.
    """
    if posed == 0:
        raise InputError(
            f"covers no image of {COLOUR_LIST}",
            where=path / TRUTH,
            expected=f"samples before and after their times, at most {LARGEST_GAP:g} s apart",
        )
    gap = float(trajectory.times.diff().median()) if len(trajectory) > 1 else 0.0
    why = (
        f"its {len(trajectory)} poses are usually {gap:.2g} s apart, like those of keyframes, and none is"
        f" interpolated over more than {LARGEST_GAP:g} s"
        if gap > LARGEST_GAP
        else f"before its first pose, after its last, or in gaps of more than {LARGEST_GAP:g} s"
    )
    remark(path / TRUTH, f"{images - posed} of {images} images have no pose and are left out: {why}")


def associate(times: Sequence[float], others: Sequence[float], largest: float) -> dict[int, int]:
    """Return the pairs of indices that are mutual nearest neighbours in time, at most ``largest`` seconds
    apart.

    Both lists are in chronological order.
    """
    if not len(times) or not len(others):
        return {}
    forth, back = _nearest(np.array(times), np.array(others)), _nearest(np.array(others), np.array(times))
    return {
        place: int(other)
        for place, other in enumerate(forth)
        if back[other] == place and abs(times[place] - others[other]) <= largest
    }


def _nearest(times: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return the index of the other time nearest to each time; the earlier one if two are equally near."""
    after = np.searchsorted(others, times).clip(1, max(1, len(others) - 1))
    before = after - 1
    after = after.clip(max=len(others) - 1)
    return np.where(np.abs(times - others[before]) <= np.abs(others[after] - times), before, after)


def _listed(path: Path) -> list[TimedRow]:
    rows = read_timed_rows(path, "filename")
    require_distinct_times(rows)
    return rows


reader = TumReader()
