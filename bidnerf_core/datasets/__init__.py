"""Readers of posed images and of sequences, and writers. All file-format conventions are converted here."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Protocol, TypeAlias, runtime_checkable

from bidnerf_core.camera.intrinsics import Intrinsics
from bidnerf_core.datasets.colmap_project import ColmapReader
from bidnerf_core.datasets.dataset import Dataset, ReadingProgress
from bidnerf_core.datasets.depth_registration import DepthCamera
from bidnerf_core.datasets.given_camera import GivenCamera
from bidnerf_core.datasets.image_folders import open_images
from bidnerf_core.datasets.scanner_app import ScannerAppReader
from bidnerf_core.datasets.sequence import (
    FileSequence,
    FrameSequence,
    SequenceEntry,
    TimedFrame,
    sequence_of,
)
from bidnerf_core.datasets.seven_scenes import SevenScenesReader
from bidnerf_core.datasets.transforms import TransformsReader
from bidnerf_core.datasets.tum import TumReader
from bidnerf_core.datasets.video import VIDEO_SUFFIXES, open_video
from bidnerf_core.datasets.writing import write_transforms
from bidnerf_core.errors import InputError, amount
from bidnerf_core.frames.photos import photos_in
from bidnerf_core.io.images import Background

__all__ = [
    "READERS",
    "Background",
    "CameraReader",
    "Dataset",
    "DepthCamera",
    "DepthRegistration",
    "DepthSensorReader",
    "FileSequence",
    "FrameSequence",
    "Reader",
    "ReadingProgress",
    "SequenceEntry",
    "SequenceReader",
    "TimedFrame",
    "given_sensor",
    "open_dataset",
    "open_sequence",
    "write_transforms",
]


@runtime_checkable
class Reader(Protocol):
    """A reader of one dataset format.

    ``expected`` names the files that its folders hold, for error messages. ``recognises`` returns whether a folder has its
    format. ``open`` returns the dataset and raises ``InputError`` if the folder cannot be used.
    """

    @property
    def expected(self) -> str: ...

    def recognises(self, path: Path) -> bool: ...

    def open(self, path: Path, background: Background | None) -> Dataset: ...


@runtime_checkable
class SequenceReader(Protocol):
    """A reader whose format records times, or frames that no split of the dataset has.

    The sequences of other readers have the frames of all splits in the natural order of their names.
    """

    def open_sequence(self, path: Path, background: Background | None) -> FrameSequence: ...


@runtime_checkable
class CameraReader(Protocol):
    """A reader whose format has no camera in its files, so that the user may give one."""

    def with_camera(self, camera: Intrinsics | Path) -> Reader: ...


@runtime_checkable
class DepthSensorReader(Protocol):
    """A reader of a format whose depth may not be registered to its colour images."""

    @property
    def sensor(self) -> DepthCamera | None:
        """The sensor from which depth is registered, unless another is given."""
        ...

    def with_depth_sensor(self, sensor: DepthCamera | None) -> Reader: ...


DepthRegistration: TypeAlias = bool | DepthCamera | str | Path
"""The registration of depth to colour images: from a sensor or a file of one, from the format's own (True), or none (False)."""

READERS: list[Reader] = [
    TransformsReader(),
    ScannerAppReader(),
    TumReader(),
    SevenScenesReader(),
    ColmapReader(),
]
"""The formats that ``open_dataset`` tries, in this order; append a reader to add one."""


def open_dataset(
    path: str | Path,
    background: Background | None = None,
    readers: Sequence[Reader] | None = None,
    camera: Intrinsics | str | Path | None = None,
    register_depth: DepthRegistration | None = None,
) -> Dataset:
    """Open the dataset in the folder ``path``. Descriptions are read and checked now, images when views are requested.

    ``background`` ("white", "black" or an rgb triple in [0, 1]) lies behind images with an alpha channel. The default is
    white where the images have one, as is the convention of NeRF-Synthetic, and black otherwise. ``camera`` (intrinsics or
    a file of them) is for formats without a camera of their own, such as TUM RGB-D. ``register_depth`` determines whether
    depth is moved to the colour camera, and from which sensor; the default depends on the format. Raises ``InputError`` where
    there is no such folder, where no reader recognises it, and where a description is not usable.
    """
    folder = Path(path)
    if not folder.exists():
        raise InputError(f"{folder}: no such folder")
    if not folder.is_dir():
        raise InputError(f"{folder}: is a file, expected the folder of a dataset")
    readers = READERS if readers is None else readers
    reader = _reader_of(folder, readers)
    if reader is None:
        raise InputError(f"{folder}: {_without_dataset(folder, readers)}")
    reader = _with_sensor(_with_camera(reader, folder, GivenCamera(camera)), folder, register_depth)
    return reader.open(folder, background)


def open_sequence(
    path: str | Path,
    *,
    camera: Intrinsics | str | Path | None = None,
    focal: float | None = None,
    hfov: float | None = None,
    assumed: Sequence[Intrinsics] = (),
    background: Background | None = None,
    readers: Sequence[Reader] | None = None,
    register_depth: DepthRegistration | None = None,
) -> FrameSequence:
    """Open the frames of ``path`` in chronological order: a dataset, a folder of images, or a video. None is read yet.

    Images and videos have the camera ``camera`` (intrinsics or a file), ``focal`` (pixels) or ``hfov`` (degrees) as in
    ``Frame.open``. Without them, images have that of their EXIF; images without a focal length, and videos, have one of the
    ``assumed`` cameras. Datasets have their own cameras, except those for which ``open_dataset`` accepts one.
    ``register_depth`` is as in ``open_dataset``; depth in a folder of images is registered if a sensor is given. Raises
    ``InputError`` where nothing is found, where a description is not usable, and for a missing or superfluous camera.
    """
    place, given = Path(path), GivenCamera(camera, focal, hfov, assumed=tuple(assumed))
    if not place.exists():
        raise InputError(f"{place}: no such file or folder")
    if not place.is_dir():
        if place.suffix.lower() not in VIDEO_SUFFIXES:
            raise InputError(
                f"{place}: is a file, expected a video ({', '.join(VIDEO_SUFFIXES)}) or a folder"
            )
        if register_depth is not None:
            raise InputError(f"{place}: is a video, which has no depth to register")
        return open_video(place, given)
    reader = _reader_of(place, READERS if readers is None else readers)
    if reader is None:
        return open_images(place, replace(given, sensor=given_sensor(place, register_depth)), background)
    reader = _with_sensor(_with_camera(reader, place, given), place, register_depth)
    if isinstance(reader, SequenceReader):
        return reader.open_sequence(place, background)
    return sequence_of(reader.open(place, background))


def given_sensor(place: Path | str, register: DepthRegistration | None) -> DepthCamera | None:
    """Return the sensor from which depth is registered, or None where depth is used as it is.

    Raises ``InputError``, which begins with ``place``, for the format's own sensor (True), and as ``DepthCamera.read`` does.
    """
    if register is True:
        raise InputError(
            f"{place}: has no depth sensor that is known, expected a file of one (register_depth=)"
        )
    if register is None or register is False:
        return None
    return register if isinstance(register, DepthCamera) else DepthCamera.read(Path(register))


def _with_sensor(reader: Reader, folder: Path, register: DepthRegistration | None) -> Reader:
    if register is None or (register is False and not isinstance(reader, DepthSensorReader)):
        return reader
    if not isinstance(reader, DepthSensorReader):
        raise InputError(
            f"{folder}: is a dataset whose depth belongs to its images, expected no registration; leave out register_depth"
        )
    if register is True and reader.sensor is not None:
        return reader
    return reader.with_depth_sensor(given_sensor(folder, register))


def _without_dataset(folder: Path, readers: Sequence[Reader]) -> str:
    """Return why a folder is no dataset, and what to do."""
    inside = [
        child.name for child in sorted(folder.iterdir()) if child.is_dir() and _reader_of(child, readers)
    ]
    if inside:
        return f"no dataset found, expected one of the folders in it, such as {inside[0]}"
    photos, _ = photos_in(folder)
    expected = "expected " + "; or ".join(reader.expected for reader in readers)
    if not photos:
        return f"no dataset found, {expected}"
    return (
        f"no dataset found: {amount(len(photos), 'photo')} without poses; COLMAP finds poses for them, or give"
        f" those of an AR framework or a robot; {expected}"
    )


def _reader_of(folder: Path, readers: Sequence[Reader]) -> Reader | None:
    return next((reader for reader in readers if reader.recognises(folder)), None)


def _with_camera(reader: Reader, folder: Path, given: GivenCamera) -> Reader:
    if not given.is_given:
        return reader
    if not isinstance(reader, CameraReader):
        raise InputError(f"{folder}: is a dataset with cameras of its own, expected no other camera")
    if given.camera is None:
        raise InputError(f"{folder}: is a dataset, expected a camera with all its intrinsics (camera=)")
    return reader.with_camera(given.camera if isinstance(given.camera, Intrinsics) else Path(given.camera))
