"""Images to localize: photos, or frames of a dataset, each read on demand."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
import torch

from bidnerf_core.datasets.capture import Capture
from bidnerf_core.datasets.colmap import SparsePoints
from bidnerf_core.datasets.formats.photos import PhotoShot
from bidnerf_core.datasets.options import AS_STORED
from bidnerf_core.datasets.reader import DatasetOptions, file_of_dataset, no_dataset
from bidnerf_core.errors import InputError, InputWarning, UsageError, amount
from bidnerf_core.fields import Observations
from bidnerf_core.frames import DEPTH_STEM, Frame, View, photos_in
from bidnerf_core.geometry import SE3, pose_from_matrix
from bidnerf_core.io import looks_like_image, read_archive, read_array, read_rows
from bidnerf_core.localization import window as windowed

log = logging.getLogger("bidnerf")

EXPECTED_POINTS = "n rows of x, y, z in metres"


@dataclass(frozen=True, eq=False)
class Query:
    """One image, or several with known relative poses, of which the last one is to be localized."""

    name: str
    views: tuple[View, ...]
    truth: SE3 | None = None  # T_world_camera if the dataset has it; used only for errors and --perturb
    depth_rays: Observations | None = None
    file: Path | None = None  # of the last image

    @property
    def frame(self) -> Frame:
        """The image to be localized."""
        return self.views[-1].frame


@runtime_checkable
class QuerySource(Protocol):
    """A source of named queries that are read one at a time."""

    @property
    def names(self) -> Sequence[str]: ...

    def read(self, index: int) -> Query:
        """Read the query with index ``index``. Raises ``InputError`` if any of its files is missing or unusable."""
        ...


@dataclass(frozen=True)
class DepthPoints:
    """Measured points from a point file, or from a COLMAP model with the points that each frame observes."""

    path: Path
    sparse: SparsePoints | None

    def rays(self, views: Sequence[View], split: str) -> Observations:
        """Return the measured points as rays in the last camera's frame."""
        if self.sparse is None:
            return read_depth_points(self.path)
        rays = self.sparse.rays(views, split)
        names = [view.frame.name for view in views]
        blind = ", ".join(name for name in names if len(self.sparse.seen(name, split)) == 0)
        log.info("%s: %s seen%s", names[-1], amount(len(rays), "point"), blind and f", but {blind} observes none")
        return rays


def read_depth_points(path: Path) -> Observations:
    """Read points (metres, OpenCV axes) as depth rays in the camera's frame.

    A text file (.txt, .csv, .xyz) has rows of x, y, z, separated by commas or spaces. Further columns are
    ignored, and ``#`` begins a comment. Text and .npy files hold points in the camera's frame, measured from
    the camera. A .npz file holds ``points`` and, for a separate sensor such as a lidar, ``T_camera_sensor``
    (4x4); the points are then in the sensor's frame. Raises ``InputError`` for anything else.
    """
    points: np.ndarray = np.zeros(0)
    T_camera_sensor = SE3.identity()
    if path.suffix == ".npz":
        arrays = read_archive(path, ("points", "T_camera_sensor"), "a .npz file of points")
        if "points" not in arrays:
            raise InputError("no array 'points'", where=path, expected=f"one with {EXPECTED_POINTS}")
        points, given = arrays["points"], arrays.get("T_camera_sensor")
        if given is not None:
            matrix = given.astype(np.float64) if given.dtype.kind in "fiu" else np.zeros(0)
            T_camera_sensor = pose_from_matrix(torch.from_numpy(matrix), "T_camera_sensor", path)
    elif path.suffix == ".npy":
        points = read_array(path, "a .npy file of points")
    else:
        rows = read_rows(path, "a file of points", EXPECTED_POINTS)
        # A row with commas has no other separator: "1,5 2,5" has decimal commas and is rejected.
        words = [(row, row.text.split("," if "," in row.text else None)[:3]) for row in rows]
        lengths = {len(found) for _, found in words}
        if len(lengths) > 1:
            found = f"has rows of {min(lengths)} and of {max(lengths)} numbers"
            raise InputError(found, where=path, expected=EXPECTED_POINTS)
        points = np.array([row.numbers(found) for row, found in words], dtype=np.float64)
    if points.ndim != 2 or points.shape[1] < 3 or points.dtype.kind not in "fiu":
        raise InputError(
            f"has an array of shape {points.shape} and type {points.dtype}",
            where=path,
            expected=EXPECTED_POINTS,
        )
    xyz = torch.from_numpy(points[:, :3].astype(np.float64))
    try:
        return Observations.from_points(xyz, T_camera_sensor)
    except InputError as error:
        raise InputError(error, where=path) from error


class Photos:
    """Image files, each of which is a query. ``depth`` maps photos that have depth to their depth files.

    If the ``options`` set no background, the background of the map in which a photo is localized is used.
    """

    def __init__(
        self,
        files: Sequence[Path],
        options: DatasetOptions = AS_STORED,
        depth: Mapping[Path, Path] | None = None,
        points: DepthPoints | None = None,
    ) -> None:
        self._depth, self._points, self._remarks = depth or {}, points, set[str]()
        sensor = options.sensor("register_depth")
        shots = [
            PhotoShot(
                image=file,
                camera=options.camera_source,
                depth_image=self._depth.get(file),
                depth_unit=options.depth_unit,
                sensor=sensor,
                awaits_background=options.background is None,
            )
            for file in files
        ]
        self.capture = Capture(Path("photos"), shots, options.colour)
        if (masks := options.mask_folder) is not None:
            self.capture = self.capture.with_masks(masks, by_stem=True)

    @property
    def names(self) -> Sequence[str]:
        return self.capture.names

    def read(self, index: int) -> Query:
        """Read the query with index ``index``. Raises ``InputError`` if any of its files is missing or unusable.

        The source of the photo's camera and any assumptions are logged, unless already logged for an earlier photo.
        """
        shot = self.capture.shots[index]
        if self._depth and shot.file not in self._depth:
            log.info("%s: no measured depth was given; colour only", shot.name)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", InputWarning)
            frame = self.capture[index].frame
        texts = [str(warning.message) for warning in caught]
        for text in [*(text.partition(": ")[2] or text for text in texts), f"{frame.camera_source}"]:
            if text not in self._remarks:
                log.info("%s: %s", shot.name, text)
            self._remarks.add(text)
        views = (View(frame, SE3.identity()),)
        rays = None if self._points is None else self._points.rays(views, "")
        return Query(frame.name, views, None, rays, shot.file)


class DatasetFrames:
    """Dataset frames as queries: one rig of the frames ``names``, or each frame of a split with the ``window - 1`` frames before it.

    The last frame of each rig is to be localized.
    """

    def __init__(
        self,
        dataset: Capture,
        split: str = "test",
        names: tuple[str, ...] = (),
        window: int = 1,
        points: DepthPoints | None = None,
    ) -> None:
        self.capture, self._split, self._points = dataset, split, points
        listed = dataset.frame_names(split)
        if not listed:
            raise InputError(f"split {split!r} has no frames", where=dataset.path)
        if window > len(listed):
            raise UsageError(f"--window is {window}", expected=f"1 to {len(listed)}")
        self._rigs = [names] if names else [(name,) for name in listed]
        if window > 1 and self._rigs[0][0] in listed:  # an unknown name is rejected on reading
            self._rigs = [windowed(listed, listed.index(rig[0]), window) for rig in self._rigs]
            for rig in self._rigs:
                if window > len(rig):
                    before = f"{rig[-1]} has only {len(rig) - 1} before it in split {split!r}"
                    log.info("--window %d: %s; a rig of %d", window, before, len(rig))

    @property
    def names(self) -> Sequence[str]:
        return [rig[-1] for rig in self._rigs]

    def read(self, index: int) -> Query:
        """Read the query with index ``index``. Raises ``InputError`` if any of its files is missing or unusable."""
        rig = self._rigs[index]
        views, (shot,) = (
            tuple(self.capture.views(self._split, rig)),
            self.capture.select(self._split, rig[-1:]),
        )
        rays = None if self._points is None else self._points.rays(views, self._split)
        return Query(views[-1].frame.name, views, views[-1].T_ref_camera, rays, shot.file)


def photo_files(paths: Sequence[Path], depth: Sequence[Path] = ()) -> list[Path]:
    """Return the files among ``paths`` and the images in the folders among them; other files in these folders are logged.

    Files of ``depth`` may lie among the photos. Raises ``InputError`` for a folder without photos.
    """
    files = list[Path]()
    for path in paths:
        if not path.is_dir():
            if (instead := file_of_dataset(path)) is not None and not looks_like_image(path):
                raise InputError(instead, where=path)
            files.append(path)
            continue
        found, others = photos_in(path)
        others = [file for file in others if file not in depth]
        if not found:
            raise no_dataset(path)
        if others:
            named = ", ".join(file.name for file in others[:5])
            more = f" and {len(others) - 5} more" if len(others) > 5 else ""
            log.info("%s: skipped %s%s: not photos by their names", path, named, more)
        files += found
    return files


def depth_files(photos: Sequence[Path], depth: Sequence[Path]) -> dict[Path, Path]:
    """Return each photo's depth file, matched by name if names agree (``NAME.png``, ``NAME.depth.png``), else by order.

    Raises ``UsageError`` if the depth files cannot be matched in either way.
    """
    if not depth:
        return {}
    by_stem = {photo.stem: photo for photo in photos}
    stems = [file.stem.removesuffix(DEPTH_STEM) for file in depth]
    if len(by_stem) == len(photos) and len(set(stems)) == len(stems) and set(stems) <= set(by_stem):
        return {by_stem[stem]: file for stem, file in zip(stems, depth, strict=True)}
    if len(depth) != len(photos):
        raise UsageError(
            f"--depth names {amount(len(depth), 'file')} for {amount(len(photos), 'photo')}",
            expected="one for each, in the same order or matched by name",
        )
    return dict(zip(photos, depth, strict=True))
