"""The queries of ``bidnerf localize``: the user's own photos, or frames of a dataset."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol, runtime_checkable

from bidnerf_core.camera.intrinsics import Intrinsics
from bidnerf_core.camera.source import CameraSource
from bidnerf_core.cli.options import UsageError, require, require_different
from bidnerf_core.cli.output import read_views, say
from bidnerf_core.datasets import READERS, Dataset, DepthRegistration, ReadOptions, open_dataset
from bidnerf_core.datasets.colmap import SparsePoints
from bidnerf_core.datasets.dataset import unique_names
from bidnerf_core.datasets.points import read_depth_points
from bidnerf_core.datasets.transforms import TransformsDataset
from bidnerf_core.errors import InputError, InputWarning, amount
from bidnerf_core.fields.observations import Observations
from bidnerf_core.frames.frame import Frame, View
from bidnerf_core.frames.photos import DEPTH_STEM, photos_in
from bidnerf_core.geometry.se3 import SE3
from bidnerf_core.localization import window as windowed

NAMED = 5
"""Maximum number of files that a message names."""


@dataclass(frozen=True, eq=False)
class Query:
    """An image, or several with known relative poses; the pose of the last one is sought."""

    name: str
    views: tuple[View, ...]
    truth: SE3 | None = None  # T_world_camera, where a dataset has it; used for errors and --perturb alone
    depth_rays: Observations | None = None
    file: Path | None = None  # of the last image

    @property
    def frame(self) -> Frame:
        """The image whose pose is sought."""
        return self.views[-1].frame


@runtime_checkable
class QuerySource(Protocol):
    """Queries by name, read one at a time."""

    @property
    def names(self) -> Sequence[str]: ...

    def read(self, place: int) -> Query:
        """Read the query at index ``place``. Raises ``InputError`` if one of its files is missing or unusable."""
        ...


@dataclass(frozen=True)
class PhotoOptions:
    """Options for reading photos."""

    depth: tuple[Path, ...] = ()
    camera: Path | None = None
    focal: float | None = None  # pixels of the image file
    hfov: float | None = None  # degrees
    depth_unit: float | None = None  # metres per step
    registration: DepthRegistration | None = None
    assumed: tuple[Intrinsics, ...] = ()  # cameras of which one probably took photos without a focal length

    @property
    def for_photos(self) -> list[str]:
        """The given options that do not apply to datasets, as written on the command line."""
        values = {"--depth": self.depth or None, "--focal": self.focal, "--hfov": self.hfov,
                  "--depth-unit": self.depth_unit}  # fmt: skip
        return [option for option, value in values.items() if value is not None]


@dataclass(frozen=True)
class FrameOptions:
    """The choice of the frames of a dataset that are queries."""

    split: str = "test"
    names: tuple[str, ...] = ()  # a rig; none: each frame of the split on its own
    window: int = 1

    def check(self) -> None:
        """Raise ``UsageError`` for names and a window that contradict each other."""
        require_different("--frame", self.names)
        require("--window", self.window, 1)
        if self.window > 1 and len(self.names) > 1:
            raise UsageError(
                f"--window {self.window} with {len(self.names)} frames, expected one: the last of the window"
            )


@dataclass(frozen=True)
class DepthPoints:
    """The argument of ``--depth-points``: a file of points, or a COLMAP model with the points that frames observe."""

    path: Path
    sparse: SparsePoints | None

    def rays(self, views: Sequence[View], split: str) -> Observations:
        """Return the measured points as rays in the last camera's frame."""
        if self.sparse is None:
            return read_depth_points(self.path)
        rays = self.sparse.rays(views, split)
        names = [view.frame.name for view in views]
        blind = ", ".join(name for name in names if len(self.sparse.seen(name, split)) == 0)
        say(f"{names[-1]}: {amount(len(rays), 'point')} seen{blind and f', none by {blind}'}")
        return rays


class Photos:
    """Image files, each a query."""

    def __init__(
        self,
        files: Sequence[Path],
        options: PhotoOptions,
        background: tuple[float, float, float],
        points: DepthPoints | None = None,
    ) -> None:
        self._files, self._options, self._background, self._points = files, options, background, points
        self._names = unique_names([(*file.parts[:-1], file.stem) for file in files])
        self._depth = _depth_files(files, options.depth)
        if options.depth_unit is not None and not options.depth:
            raise UsageError(
                "--depth-unit was given without --depth, expected the depth image that it belongs to"
            )
        if options.registration and not options.depth:
            raise UsageError(
                "--register-depth was given without --depth, expected measured depth to register"
            )
        self._sensor = ReadOptions(register_depth=options.registration).sensor("--register-depth")
        self._camera = CameraSource(options.camera, options.focal, options.hfov, options.assumed)
        self._remarks: set[str] = set()

    @property
    def names(self) -> Sequence[str]:
        return self._names

    def read(self, place: int) -> Query:
        file, options = self._files[place], self._options
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", InputWarning)
            frame = Frame.read(
                file, self._camera, depth=self._depth.get(file), depth_unit=options.depth_unit,
                sensor=self._sensor, background=self._background,
            )  # fmt: skip
        name = self._names[place]
        for warning in caught:
            self._remark(name, str(warning.message).partition(": ")[2] or str(warning.message))
        self._remark(name, f"{frame.camera_source}")
        if self._depth and file not in self._depth:
            say(f"{name}: no measured depth was given; colour only")
        views = (View(replace(frame, name=name), SE3.identity()),)
        rays = None if self._points is None else self._points.rays(views, "")
        return Query(name, views, depth_rays=rays, file=file)

    def _remark(self, name: str, text: str) -> None:
        """Print the source of a camera, or what was assumed, unless the same was printed for an earlier photo."""
        if text not in self._remarks:
            self._remarks.add(text)
            say(f"{name}: {text}")


class DatasetFrames:
    """Frames of a dataset as queries: each frame of a split with the window before it, or one rig."""

    def __init__(self, dataset: Dataset, options: FrameOptions, points: DepthPoints | None = None) -> None:
        self._dataset, self._split, self._points = dataset, options.split, points
        listed = dataset.frame_names(options.split)
        if not listed:
            raise InputError(f"{dataset.path}: split {options.split!r} has no frames")
        if options.window > 1:
            require("--window", options.window, 1, len(listed))
        asked = [options.names] if options.names else [(name,) for name in listed]
        self._rigs = [self._with_window(rig, listed, options.window) for rig in asked]

    @property
    def names(self) -> Sequence[str]:
        return [rig[-1] for rig in self._rigs]

    def read(self, place: int) -> Query:
        rig = self._rigs[place]
        views = tuple(read_views(self._dataset, self._split, rig))
        file = None
        if isinstance(self._dataset, TransformsDataset):
            file = self._dataset.image_file(self._split, views[-1].frame.name)
        rays = None if self._points is None else self._points.rays(views, self._split)
        return Query(views[-1].frame.name, views, views[-1].T_ref_camera, rays, file)

    def _with_window(self, rig: tuple[str, ...], listed: list[str], size: int) -> tuple[str, ...]:
        if size == 1 or rig[0] not in listed:  # an unknown name is rejected when it is read
            return rig
        names = windowed(listed, listed.index(rig[0]), size)
        if len(names) < size:
            before = f"{names[-1]} has {len(names) - 1} before it in split {self._split!r}"
            say(f"--window {size}: {before}; a rig of {len(names)}")
        return names


def open_queries(
    paths: Sequence[Path], photos: PhotoOptions, frames: FrameOptions, background: tuple[float, float, float],
    points: DepthPoints | None,
) -> QuerySource:  # fmt: skip
    """Return the queries that QUERY stands for: image files and folders of them, or one dataset.

    Raises ``InputError`` where there is nothing of either kind, and ``UsageError`` for options of the other kind.
    """
    datasets = [path for path in paths if path.is_dir() and any(r.recognises(path) for r in READERS)]
    if frames.names or datasets:
        return _dataset(paths, photos, frames, background, points)
    if frames.window > 1:
        raise UsageError(f"--window {frames.window} needs known relative poses, expected a dataset")
    files = _photo_files(paths, photos.depth)
    if points is not None and points.sparse is None and len(files) > 1:
        raise UsageError(f"{points.path}: points of one camera, but {len(files)} photos; expected one photo")
    return Photos(files, photos, background, points)


def _dataset(
    paths: Sequence[Path], photos: PhotoOptions, frames: FrameOptions, background: tuple[float, float, float],
    points: DepthPoints | None,
) -> QuerySource:  # fmt: skip
    if len(paths) > 1:
        raise UsageError(f"{len(paths)} queries with a dataset among them, expected the dataset alone")
    if photos.for_photos:
        raise UsageError(
            f"{photos.for_photos[0]} is for photos, but {paths[0]} is a dataset, which has its own; to take its images as"
            " photos, name the files"
        )
    dataset = open_dataset(paths[0], background, camera=photos.camera, register_depth=photos.registration)
    source = DatasetFrames(dataset, frames, points)
    if points is not None and points.sparse is None and len(source.names) > 1:
        raise UsageError(
            f"{points.path}: points of one camera, but {len(source.names)} frames; name one by --frame"
        )
    return source


def _photo_files(paths: Sequence[Path], depth: Sequence[Path]) -> list[Path]:
    """Return the image files among ``paths`` and in folders among them; other files there are skipped with a message."""
    files = list[Path]()
    for path in paths:
        if not path.is_dir():
            files.append(path)
            continue
        found, others = photos_in(path)
        others = [file for file in others if file not in depth]
        if not found:
            formats = " or ".join(reader.expected for reader in READERS)
            raise InputError(f"{path}: no photos in it, and no dataset ({formats})")
        if others:
            named = ", ".join(file.name for file in others[:NAMED])
            more = f" and {len(others) - NAMED} more" if len(others) > NAMED else ""
            say(f"{path}: skipped {named}{more}: not photos by their names")
        files += found
    return files


def _depth_files(photos: Sequence[Path], depth: Sequence[Path]) -> dict[Path, Path]:
    """Return the depth file of each photo: by name where names agree (``NAME.png``, ``NAME.depth.png``), else in order.

    Raises ``UsageError`` where depth files can be assigned in neither way.
    """
    by_stem = {photo.stem: photo for photo in photos}
    stems = [file.stem.removesuffix(DEPTH_STEM) for file in depth]
    if len(by_stem) == len(photos) and len(set(stems)) == len(stems) and set(stems) <= set(by_stem):
        return {by_stem[stem]: file for stem, file in zip(stems, depth, strict=True)}
    if len(depth) != len(photos):
        raise UsageError(
            f"--depth names {amount(len(depth), 'file')} for {amount(len(photos), 'photo')}, expected one for each, in the"
            " same order or matched by name"
        )
    return dict(zip(photos, depth, strict=True))
