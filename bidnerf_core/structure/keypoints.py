"""Keypoints of photos in COLMAP's database, with the cameras that probably took the photos.

Photos of the same size whose EXIF states the same lens share a camera. Its initial focal length is that of
EXIF, or a typical one, and is estimated with the poses. A given camera is kept fixed.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from bidnerf_core.camera import (
    UPRIGHT,
    CameraSource,
    Exif,
    Intrinsics,
    Raster,
    camera_from_exif,
    read_exif,
    reduced_size,
)
from bidnerf_core.errors import InputError
from bidnerf_core.io import read_header, read_image
from bidnerf_core.mapping import Keypoints, Sift
from bidnerf_core.progress import counter
from bidnerf_core.structure.library import to_colmap
from bidnerf_core.structure.sources import SourceImage

LARGEST = 1600
"""Pixels along the longer side to which photos are downscaled: more give slightly more accurate poses, but
take far longer."""
DETECTOR = Sift(count=4096, largest=LARGEST)


@dataclass(frozen=True)
class ListedPhoto:
    """A readable photo: its size as stored, the size at which its keypoints are found, and the number of its camera."""

    image: SourceImage
    number: int  # in the database, from 1
    size: tuple[int, int]  # width and height as stored
    reduced: tuple[int, int]
    exif: Exif
    camera: int = 0  # in the database, from 1


@dataclass(frozen=True)
class Described:
    """The readable photos, and why the others cannot be read."""

    photos: list[ListedPhoto]
    cameras: dict[int, Intrinsics]  # of reduced photos, by number
    known_focal: dict[int, bool]  # whether EXIF or the user states the focal length
    unusable: dict[str, str]  # reasons by name


def described(images: Sequence[SourceImage], given: Intrinsics | str | Path | None) -> Described:
    """Read the headers of photos, and group the photos by camera.

    Raises ``InputError`` for a ``given`` camera that does not fit.
    """
    photos, unusable = list[ListedPhoto](), dict[str, str]()
    for number, image in enumerate(images, start=1):
        try:
            header, exif = read_header(image.file), read_exif(image.file)
        except InputError as error:
            unusable[image.name] = _without_file(error, image)
            continue
        size = (header.width, header.height)
        photos.append(ListedPhoto(image, number, size, reduced_size(*size, LARGEST), exif))
    numbers: dict[Any, int] = {}
    cameras, known = dict[int, Intrinsics](), dict[int, bool]()
    for place, photo in enumerate(photos):
        number = numbers.setdefault((photo.size, replace(photo.exif, orientation=UPRIGHT)), len(numbers) + 1)
        photos[place] = replace(photo, camera=number)
        if number not in cameras:
            camera, known[number] = _first_guess(photo, given)
            cameras[number] = camera.resized(*photo.reduced)
    return Described(photos, cameras, known, unusable)


def _first_guess(photo: ListedPhoto, given: Intrinsics | str | Path | None) -> tuple[Intrinsics, bool]:
    raster = Raster(*photo.size)
    if given is not None:
        return CameraSource(given).find(photo.image.file, raster).intrinsics, True
    exif = replace(photo.exif, orientation=UPRIGHT)
    if exif.has_focal_length:
        try:
            return camera_from_exif(str(photo.image.file), raster, exif).intrinsics, True
        except InputError:  # cropped after it was taken
            pass
    return Intrinsics.from_focal(1.2 * max(photo.size), *photo.size), False  # as COLMAP assumes


def key(number: int) -> str:
    """Return the name in the database of the photo with this number.

    Its file name may contain spaces, which COLMAP's pair lists do not allow.
    """
    return f"{number:06d}"


def write_cameras(database: Any, found: Described, fixed: bool, pycolmap: Any) -> None:
    """Write cameras and photos to an empty database. A camera that is not ``fixed`` has one radial coefficient."""
    with pycolmap.DatabaseTransaction(database):
        for number, intrinsics in found.cameras.items():
            camera = to_colmap(intrinsics, number, pycolmap)
            if not fixed:
                width, height = intrinsics.width, intrinsics.height
                camera = pycolmap.Camera(
                    camera_id=number, model="SIMPLE_RADIAL", width=width, height=height,
                    params=[intrinsics.fx, width / 2, height / 2, 0.0],
                )  # fmt: skip
            camera.has_prior_focal_length = found.known_focal[number]
            database.write_camera(camera, use_camera_id=True)
            rig = pycolmap.Rig(rig_id=number)
            rig.add_ref_sensor(camera.sensor_id)
            database.write_rig(rig, use_rig_id=True)
        for photo in found.photos:
            image = pycolmap.Image(name=key(photo.number), camera_id=photo.camera, image_id=photo.number)
            database.write_image(image, use_image_id=True)
            frame = pycolmap.Frame(frame_id=photo.number, rig_id=photo.camera)
            frame.add_data_id(image.data_id)
            database.write_frame(frame, use_frame_id=True)


def write_keypoints(database: Any, found: Described, pycolmap: Any) -> dict[str, str]:
    """Find the keypoints missing from the database, and return by name why photos could not be decoded.

    Keypoints found until the job is cancelled are stored.
    """
    count = counter("finding keypoints", "photos")
    missing = [photo for photo in found.photos if not database.exists_keypoints(photo.number)]
    done, total = len(found.photos) - len(missing), len(found.photos)
    unusable = dict[str, str]()
    with ThreadPoolExecutor(max(1, torch.get_num_threads())) as pool:
        try:
            for photo, keypoints in zip(missing, pool.map(_keypoints, missing), strict=True):
                if isinstance(keypoints, InputError):
                    unusable[photo.image.name] = _without_file(keypoints, photo.image)
                else:
                    kind, found_there = pycolmap.FeatureExtractorType.SIFT, keypoints.descriptors.numpy()
                    with pycolmap.DatabaseTransaction(database):
                        database.write_keypoints(photo.number, keypoints.pixels.float().numpy())
                        database.write_descriptors(
                            photo.number, pycolmap.FeatureDescriptors(kind, found_there)
                        )
                done += 1
                count(done, total)
        finally:
            pool.shutdown(cancel_futures=True)
    return unusable


def _keypoints(photo: ListedPhoto) -> Keypoints | InputError:
    """Return the keypoints of the downscaled photo, without those on its background."""
    try:
        rgb, alpha = read_image(photo.image.file, size=photo.reduced)
    except InputError as error:
        return error
    found = DETECTOR(rgb)
    if alpha is None:
        return found
    columns, rows = found.pixels.long().unbind(-1)
    inside = alpha[rows.clamp(0, alpha.shape[0] - 1), columns.clamp(0, alpha.shape[1] - 1)] > 0.5
    return found[inside]


def _without_file(error: InputError, image: SourceImage) -> str:
    """Return a message without the leading file path, which is shown next to it anyway."""
    return str(error).removeprefix(f"{image.file}: ")
