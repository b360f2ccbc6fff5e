"""Folders of 12-Scenes (https://graphics.stanford.edu/projects/reloc): an iPad's photos with a Structure sensor's depth.

A scene has ``info.txt`` (``m_calibrationColorIntrinsic`` and ``m_calibrationDepthIntrinsic``, 4x4, of images
of ``m_colorWidth`` x ``m_colorHeight`` and ``m_depthWidth`` x ``m_depthHeight``), ``split.txt`` (``sequence0
[frames=357] [start=0 ; end=356]``) and ``data`` with ``frame-000000.color.jpg``, ``frame-000000.depth.png``
(16-bit planar z in millimetres) and ``frame-000000.pose.txt`` (4x4, camera to world, OpenCV axes, metres;
-INF if tracking failed). Depth is registered to the colour camera by the two calibrations. As in the
relocalization literature (the successors of SCoRe Forests, DSAC, ACE) the first sequence is "test" and the
others are "train"; without ``split.txt`` every eighth frame is held out.
"""

from __future__ import annotations

import re
from pathlib import Path

import torch

from bidnerf_core.camera import CameraSource, Intrinsics
from bidnerf_core.datasets.dataset import Dataset
from bidnerf_core.datasets.pose_rows import LARGEST_POSE, read_pose_matrix
from bidnerf_core.datasets.posed_images import ImageFrame, MetricImageDataset, images_posed
from bidnerf_core.datasets.reader import OpenQuestion, Reader, ReadOptions
from bidnerf_core.datasets.rgbd import DepthFile
from bidnerf_core.datasets.sequence import FrameSequence
from bidnerf_core.datasets.splits import Splits, hold_out
from bidnerf_core.depth import MILLIMETRE, DepthCamera, DepthReader
from bidnerf_core.errors import InputError
from bidnerf_core.frames import natural_order
from bidnerf_core.geometry import SE3
from bidnerf_core.io import is_file, read_rows

INFO = ("info.txt", "_info.txt")
COLOUR = re.compile(r"frame-(\d+)\.color\.(?:png|jpe?g)", re.IGNORECASE)
RANGE = re.compile(r"start\s*=\s*(\d+)\s*;\s*end\s*=\s*(\d+)")
FOCAL_TOLERANCE = 1e-3
"""Relative difference of two focal lengths below which depth needs no registration."""


class TwelveScenesReader(Reader):
    """Reader for 12-Scenes folders."""

    accepts: tuple[OpenQuestion, ...] = ("camera", "register_depth", "depth_unit")
    expected = "info.txt with data/frame-000000.color.jpg ... (12-Scenes)"

    def recognises(self, path: Path) -> bool:
        return _info(path) is not None and _data(path) is not None

    def open(self, path: Path, options: ReadOptions) -> Dataset:
        """Read the poses. Raises ``InputError`` if a metadata file is invalid, and if no frame has a pose."""
        frames = images_posed(path, _frames(path, options))
        dataset = MetricImageDataset(Splits(path, _splits(path, frames)), options.background)
        dataset.depth_unit = _metres_per_step(options)
        return dataset

    def open_sequence(self, path: Path, options: ReadOptions) -> FrameSequence:
        frames = _frames(path, options)
        posed = [frame for frame in frames if frame.T_world_camera is not None]
        others = [frame for frame in frames if frame.T_world_camera is None]
        return MetricImageDataset(Splits(path, _splits(path, posed)), options.background).sequence(others)


def _info(path: Path) -> Path | None:
    return next(
        (place / name for place in (path, path.parent) for name in INFO if is_file(place / name)), None
    )


def _data(path: Path) -> Path | None:
    places = [place for place in (path / "data", path) if place.is_dir()]
    return next((place for place in places if any(map(COLOUR.fullmatch, _names(place)))), None)


def _names(folder: Path) -> list[str]:
    return [file.name for file in folder.glob("frame-*")]


def _frames(path: Path, options: ReadOptions) -> list[ImageFrame]:
    folder, info = _data(path), _info(path)
    assert folder is not None  # ensured by recognises
    assert info is not None
    colour, own = _cameras(info)
    camera = CameraSource(options.camera or colour)
    read, sensor = DepthReader(documented=("65535",)), options.sensor(path, own)
    images = [file for file in folder.iterdir() if COLOUR.fullmatch(file.name)]
    frames = []
    for image in sorted(images, key=lambda file: natural_order(file.name)):
        stem = image.name.partition(".")[0]
        depth = folder / f"{stem}.depth.png"
        measured = DepthFile(depth, _metres_per_step(options), read, sensor) if is_file(depth) else None
        frames.append(ImageFrame(image, camera, _pose(folder / f"{stem}.pose.txt"), None, measured))
    return frames


def _metres_per_step(options: ReadOptions) -> float:
    return MILLIMETRE if options.depth_unit is None else options.depth_unit


def _pose(file: Path) -> SE3 | None:
    """Return the pose in a file, or None if there is none or tracking failed."""
    if not is_file(file):
        return None
    rows = read_rows(file, "a file of a pose", "4 rows of 4 numbers", LARGEST_POSE)
    numbers = torch.tensor([number for row in rows for number in row.plain_numbers(row.words)])
    return read_pose_matrix(file) if bool(numbers.isfinite().all()) else None


def _cameras(info: Path) -> tuple[Intrinsics, DepthCamera | None]:
    """Return the colour camera, and the depth sensor if it is a different camera."""
    values: dict[str, list[float]] = {}
    for row in read_rows(info, "12-Scenes' info.txt", "name = numbers"):
        name, _, text = row.text.partition("=")
        if name.strip().startswith(("m_calibration", "m_color", "m_depth")):
            values[name.strip()] = row.plain_numbers(text.split())
    colour, depth = (_camera(info, values, kind) for kind in ("Color", "Depth"))
    if colour is None:
        raise InputError(
            "no m_calibrationColorIntrinsic",
            where=info,
            expected="16 numbers, with m_colorWidth and m_colorHeight",
        )
    if depth is None or abs(depth.resized(colour.width, colour.height).fx / colour.fx - 1) < FOCAL_TOLERANCE:
        return colour, None
    return colour, DepthCamera(depth, SE3.identity())


def _camera(info: Path, values: dict[str, list[float]], kind: str) -> Intrinsics | None:
    matrix = values.get(f"m_calibration{kind}Intrinsic", [])
    size = [values.get(f"m_{kind.lower()}{side}", []) for side in ("Width", "Height")]
    if len(matrix) not in (9, 16) or not all(size):
        return None
    row = 4 if len(matrix) == 16 else 3
    try:
        return Intrinsics(
            matrix[0],
            matrix[row + 1],
            matrix[2] + 0.5,
            matrix[row + 2] + 0.5,
            int(size[0][0]),
            int(size[1][0]),
        )
    except InputError as error:
        raise InputError(error, where=info) from error


def _splits(path: Path, frames: list[ImageFrame]) -> dict[str, list[ImageFrame]]:
    """Return the frames of the first sequence as "test" and the others as "train"."""
    file = next((place / "split.txt" for place in (path, path.parent) if is_file(place / "split.txt")), None)
    if not frames or file is None:
        return hold_out(frames) if frames else {}
    ranges = [RANGE.search(row.text) for row in read_rows(file, "a list of sequences", "start and end")]
    first = next((found for found in ranges if found is not None), None)
    if first is None:
        raise InputError("has no [start=0 ; end=356]", where=file, expected="the frames of each sequence")
    start, end = int(first[1]), int(first[2])
    test = [frame for frame in frames if start <= int(frame.stem.partition("-")[2]) <= end]
    train = [frame for frame in frames if frame not in test]
    return {split: group for split, group in (("train", train), ("test", test)) if group}


reader = TwelveScenesReader()
