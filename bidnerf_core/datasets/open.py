"""Opens datasets, folders of images and videos, whatever their format."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from bidnerf_core.camera import Camera, CameraSource, Intrinsics
from bidnerf_core.datasets.dataset import Dataset
from bidnerf_core.datasets.image_folders import open_images
from bidnerf_core.datasets.masked import MaskedDataset, mask_folder, masked_sequence
from bidnerf_core.datasets.reader import (
    DepthRegistration,
    Reader,
    ReadOptions,
    checked_unit,
    expected_formats,
    file_of_dataset,
    find_reader,
    may_hold,
    no_dataset,
    opened,
    opened_sequence,
)
from bidnerf_core.datasets.sequence import (
    FrameSequence,
)
from bidnerf_core.datasets.video import VIDEO_SUFFIXES, is_video, open_video
from bidnerf_core.errors import InputError, amount
from bidnerf_core.frames import MaskFolder, photos_in
from bidnerf_core.io import Background


def open_dataset(
    path: str | Path,
    background: Background | None = None,
    readers: Sequence[Reader] | None = None,
    camera: Camera | str | Path | None = None,
    register_depth: DepthRegistration | None = None,
    depth_unit: float | None = None,
    masks: str | Path | MaskFolder | None = None,
) -> Dataset:
    """Open the dataset in the folder ``path``. Its metadata are read and checked immediately, images when
    views are requested.

    ``background`` ("white", "black" or an rgb triple in [0, 1]) lies behind images with an alpha channel. It
    defaults to white if the images have one, following NeRF-Synthetic, and to black otherwise. ``camera``
    (intrinsics or a file of them) is for formats that store no camera, such as TUM RGB-D. ``register_depth``
    determines whether depth is registered to the colour camera, and from which sensor; the default depends on
    the format. ``depth_unit`` (metres per step of depth images) overrides the unit of the format. ``masks``
    is a folder of images whose black pixels are ignored (see ``MaskFolder``). Files that are listed but
    missing are left out, with an ``InputWarning`` that counts them. Raises ``InputError`` if there is no such
    folder, if no reader recognizes it, if nothing is left, and if a metadata file is invalid.
    """
    folder = Path(path)
    if not folder.exists():
        raise InputError("no such folder", where=folder)
    reader = _reader_of(folder, readers)
    if reader is None and not folder.is_dir():
        raise _not_a_dataset(folder)
    if reader is None:
        raise _without_dataset(folder, readers)
    options = _options(reader, folder, CameraSource(camera), background, register_depth, depth_unit)
    found = opened(reader, folder, options)
    return found if masks is None else MaskedDataset(found, mask_folder(masks))


def open_sequence(
    path: str | Path,
    *,
    camera: Camera | str | Path | None = None,
    focal: float | None = None,
    hfov: float | None = None,
    assumed: Sequence[Intrinsics] = (),
    background: Background | None = None,
    readers: Sequence[Reader] | None = None,
    register_depth: DepthRegistration | None = None,
    depth_unit: float | None = None,
    masks: str | Path | MaskFolder | None = None,
) -> FrameSequence:
    """Open the frames of ``path`` in chronological order: a dataset, a folder of images, or a video. Nothing
    is decoded yet.

    The camera of images and videos is ``camera`` (intrinsics or a file), ``focal`` (pixels) or ``hfov``
    (degrees), as in ``Frame.open``. Without these, images use their EXIF; images without a focal length, and
    videos, use one of the ``assumed`` cameras. Datasets have their own cameras, except those for which
    ``open_dataset`` accepts one. ``register_depth``, ``depth_unit`` and ``masks`` are as in ``open_dataset``;
    depth in a folder of images is registered if a sensor is given, and in millimetres unless a unit is given.
    Raises ``InputError`` if nothing is found, if a metadata file is invalid, and for a missing or superfluous
    camera.
    """
    if masks is not None:
        unmasked = open_sequence(
            path, camera=camera, focal=focal, hfov=hfov, assumed=assumed, background=background, readers=readers,
            register_depth=register_depth, depth_unit=depth_unit,
        )  # fmt: skip
        return masked_sequence(unmasked, mask_folder(masks))
    place, given = Path(path), CameraSource(camera, focal, hfov, tuple(assumed))
    if not place.exists():
        raise InputError("no such file or folder", where=place)
    reader = _reader_of(place, readers)
    if reader is None and not place.is_dir():
        if not is_video(place):
            raise _not_a_dataset(place, f", or a video ({', '.join(VIDEO_SUFFIXES)})")
        if register_depth is not None:
            raise InputError("is a video, which has no depth to register", where=place)
        return open_video(place, given)
    if reader is None:
        sensor = ReadOptions(register_depth=register_depth).sensor(place)
        return open_images(place, given, sensor, background, checked_unit(depth_unit))
    options = _options(reader, place, given, background, register_depth, depth_unit)
    return opened_sequence(reader, place, options)


def _options(
    reader: Reader,
    folder: Path,
    camera: CameraSource,
    background: Background | None,
    register: DepthRegistration | None,
    depth_unit: float | None,
) -> ReadOptions:
    """Build the options for a reader. Raises ``InputError`` for options that the format does not accept."""
    if camera.is_given and "camera" not in reader.accepts:
        raise InputError("is a dataset with its own cameras; leave out the camera", where=folder)
    if camera.is_given and camera.camera is None:
        raise InputError("is a dataset", where=folder, expected="a camera with all intrinsics (camera=)")
    if register not in (None, False) and "register_depth" not in reader.accepts:
        raise InputError(
            "is a dataset whose depth is already registered to its images; leave out register_depth",
            where=folder,
        )
    if depth_unit is not None and "depth_unit" not in reader.accepts:
        raise InputError(
            "is a dataset without depth images, or with depth in a fixed unit; leave out depth_unit",
            where=folder,
        )
    given = camera.camera
    return ReadOptions(
        background, Path(given) if isinstance(given, str) else given, register, checked_unit(depth_unit)
    )


def _not_a_dataset(file: Path, or_else: str = "") -> InputError:
    """Return the error for a file in place of a dataset; ``or_else`` names what else could be given."""
    if (instead := file_of_dataset(file)) is not None:
        return InputError(f"{instead}{or_else}", where=file)
    packed = file.suffix.lower() in (".zip", ".tar", ".gz", ".tgz", ".7z", ".rar")
    unpack = "; unpack the archive first" if packed else ""
    return InputError("is a file", where=file, expected=f"the folder of a dataset{unpack}{or_else}")


def _without_dataset(folder: Path, readers: Sequence[Reader] | None) -> InputError:
    """Return the error for a folder that is no dataset, and what to do."""
    inside = [
        child.name for child in sorted(folder.iterdir()) if child.is_dir() and _reader_of(child, readers)
    ]
    if inside:
        expected = f"one of the folders in it, such as {inside[0]}"
        return InputError("no dataset found", where=folder, expected=expected)
    photos, _ = photos_in(folder)
    if not photos and readers is None:
        return no_dataset(folder)
    found = "no dataset found"
    if photos:
        found += (
            f": {amount(len(photos), 'photo')} without poses; 'bidnerf poses' finds them, or give those of an AR"
            " framework or a robot;"
        )
    return InputError(found, where=folder, expected=expected_formats(readers))


def _reader_of(folder: Path, readers: Sequence[Reader] | None) -> Reader | None:
    if readers is None:
        return find_reader(folder)
    return next(
        (reader for reader in readers if may_hold(reader, folder) and reader.recognises(folder)), None
    )
