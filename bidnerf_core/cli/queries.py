"""The arguments of ``bidnerf localize`` that specify its queries: the user's own photos, or frames of a dataset."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from bidnerf_core.camera import CameraSource
from bidnerf_core.cli.options import require, require_different
from bidnerf_core.datasets import (
    DatasetFrames,
    DepthPoints,
    DepthRegistration,
    Photos,
    QuerySource,
    ReadOptions,
    depth_files,
    find_reader,
    open_dataset,
    photo_files,
)
from bidnerf_core.errors import UsageError
from bidnerf_core.frames import MaskFolder
from bidnerf_core.io import IMAGE_SUFFIXES


@dataclass(frozen=True)
class PhotoOptions:
    """Options for reading photos."""

    depth: tuple[Path, ...] = ()
    camera: CameraSource = CameraSource()
    depth_unit: float | None = None  # metres per step
    registration: DepthRegistration | None = None
    masks: MaskFolder | None = None

    @property
    def for_photos(self) -> list[str]:
        """The given options that do not apply to datasets, as written on the command line."""
        values = {"--depth": self.depth or None, "--focal": self.camera.focal, "--hfov": self.camera.hfov}
        return [option for option, value in values.items() if value is not None]

    def check_depth(self) -> None:
        """Raise ``UsageError`` for options of depth images if none are given."""
        for option, value in (("--depth-unit", self.depth_unit), ("--register-depth", self.registration)):
            if value and not self.depth:
                raise UsageError(
                    f"{option} was given without --depth", expected="the depth image that it belongs to"
                )


@dataclass(frozen=True)
class FrameOptions:
    """The choice of dataset frames used as queries."""

    split: str = "test"
    names: tuple[str, ...] = ()  # a rig; empty: each frame of the split on its own
    window: int = 1

    def check(self) -> None:
        """Raise ``UsageError`` for names and a window that contradict each other."""
        require_different("--frame", self.names)
        require("--window", self.window, 1)
        if self.window > 1 and len(self.names) > 1:
            raise UsageError(
                f"--window {self.window} with {len(self.names)} frames",
                expected="one: the last of the window",
            )


def open_queries(
    paths: Sequence[Path], photos: PhotoOptions, frames: FrameOptions, background: tuple[float, float, float] | None,
    points: DepthPoints | None,
) -> QuerySource:  # fmt: skip
    """Return the queries for the QUERY arguments: image files and folders of them, or one dataset.

    Raises ``InputError`` if there is nothing of either kind, and ``UsageError`` for options that belong to
    the other kind.
    """
    datasets = [
        path for path in paths if path.suffix.lower() not in IMAGE_SUFFIXES and find_reader(path) is not None
    ]
    if frames.names or datasets:
        return _dataset(paths, photos, frames, background, points)
    if frames.window > 1:
        raise UsageError(f"--window {frames.window} needs known relative poses", expected="a dataset")
    files = photo_files(paths, photos.depth)
    _check_points(points, len(files), "photos; expected one photo")
    depth = depth_files(files, photos.depth)
    photos.check_depth()
    sensor = ReadOptions(register_depth=photos.registration).sensor("--register-depth")
    return Photos(files, photos.camera, depth, photos.depth_unit, sensor, background, points, photos.masks)


def _dataset(
    paths: Sequence[Path], photos: PhotoOptions, frames: FrameOptions, background: tuple[float, float, float] | None,
    points: DepthPoints | None,
) -> QuerySource:  # fmt: skip
    if len(paths) > 1:
        raise UsageError(f"{len(paths)} queries including a dataset", expected="only the dataset")
    if photos.for_photos:
        raise UsageError(
            f"{photos.for_photos[0]} is for photos, but {paths[0]} is a dataset, which has its own; to use"
            " its images as photos, name the files"
        )
    dataset = open_dataset(
        paths[0],
        background,
        camera=photos.camera.camera,
        register_depth=photos.registration,
        depth_unit=photos.depth_unit,
        masks=photos.masks,
    )
    source = DatasetFrames(dataset, frames.split, frames.names, frames.window, points)
    _check_points(points, len(source.names), "frames; name one by --frame")
    return source


def _check_points(points: DepthPoints | None, queries: int, expected: str) -> None:
    if points is not None and points.sparse is None and queries > 1:
        raise UsageError(f"points of a single camera, but {queries} {expected}", where=points.path)
