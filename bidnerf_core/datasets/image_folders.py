"""Folders of images without poses, as sequences."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from bidnerf_core.camera import CameraSource
from bidnerf_core.datasets.dataset import unique_names
from bidnerf_core.datasets.sequence import FileSequence, SequenceEntry, timestamp
from bidnerf_core.depth import MILLIMETRE, DepthCamera
from bidnerf_core.errors import InputError
from bidnerf_core.frames import DEPTH_STEM, Frame, photos_in
from bidnerf_core.io import Background


def open_images(
    folder: Path,
    camera: CameraSource,
    sensor: DepthCamera | None,
    background: Background | None = None,
    depth_unit: float | None = None,
) -> FileSequence:
    """Return the images of a folder, ordered by timestamp if every name is one (``12.345.png``), else in natural name order.

    The depth of ``NAME.png``, if any, is ``NAME.depth.png``, as written by ``bidnerf render``, in steps of ``depth_unit``
    metres (default 0.001). The camera of an image is ``camera`` or, failing that, comes from its EXIF data, as in
    ``Frame.open``. If ``sensor`` is given, depth is registered from that camera to the image. Images with an alpha channel
    are composited over ``background`` (default black). Raises ``InputError`` if the folder contains no images.
    """
    photos, _ = photos_in(folder)
    if not photos:
        raise InputError("no images in it", where=folder, expected="image files or a dataset")
    names = unique_names([(*photo.parts[:-1], photo.stem) for photo in photos])

    def read(photo: Path) -> tuple[Frame, None]:
        beside = photo.with_name(f"{photo.stem}{DEPTH_STEM}.png")
        depth, unit = (beside, depth_unit or MILLIMETRE) if beside.is_file() else (None, None)
        behind: Background = "black" if background is None else background
        frame = Frame.read(photo, camera, depth=depth, depth_unit=unit, sensor=sensor, background=behind)
        return frame, None

    return FileSequence.ordered(
        folder,
        [
            SequenceEntry(name, timestamp(photo.stem), None, partial(read, photo))
            for name, photo in zip(names, photos, strict=True)
        ],
    )
