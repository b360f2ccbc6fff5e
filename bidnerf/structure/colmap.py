"""COLMAP's database of photos: their cameras and keypoints.

Photos of the same size whose EXIF states the same lens share a camera. The initial focal length is that of
EXIF or a typical one, and is refined together with the poses. A camera given by the user is kept fixed.
"""

from __future__ import annotations

import contextlib
import signal
import threading
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from bidnerf_core.camera import (
    UPRIGHT,
    Camera,
    CameraSource,
    Exif,
    Intrinsics,
    Raster,
    camera_from_exif,
    colmap_model,
    read_exif,
    reduced_size,
)
from bidnerf_core.datasets import Capture, Shot, photo_camera
from bidnerf_core.devices import map_tasks
from bidnerf_core.errors import InputError, amount
from bidnerf_core.geometry import Similarity
from bidnerf_core.installation import import_extra
from bidnerf_core.io import read_compact_image, read_header
from bidnerf_core.mapping import Keypoints, Sift
from bidnerf_core.progress import counter

MATCHED_SIDE = 1600
"""Longer side of downscaled photos (pixels). Larger ones give slightly more accurate poses, but take far longer."""
DETECTOR = Sift(count=4096, largest=MATCHED_SIDE)
LEAST_PHOTOS = 3
"""Smallest number of photos in a model: two photos have a single baseline, which allows no check."""


def import_pycolmap(what: str) -> Any:
    """Import pycolmap and silence its log.

    Raises ``InputError`` if pycolmap is missing or too old; the message begins with ``what``.
    """
    pycolmap = import_extra("pycolmap", "sfm", "finding the poses of photos", what)
    if threading.current_thread() is threading.main_thread():  # pycolmap's handler prints a stack and ends the process
        signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGTERM) or signal.SIG_DFL)
    pycolmap.logging.minloglevel = pycolmap.logging.Level.FATAL.value
    return pycolmap


@dataclass(frozen=True)
class ListedPhoto:
    """A readable photo: its size as stored, the size at which keypoints are detected, and the number of its camera."""

    shot: Shot
    file: Path
    number: int  # in the database, from 1
    size: tuple[int, int]  # width and height as stored
    reduced: tuple[int, int]
    exif: Exif
    camera: int  # in the database, from 1


@dataclass
class PhotoSet:
    """The readable photos and their cameras, and the reasons why other photos cannot be read."""

    photos: list[ListedPhoto] = field(default_factory=list)
    cameras: dict[int, Camera] = field(default_factory=dict)  # of reduced photos, by number
    fixed: set[int] = field(default_factory=set)  # numbers of the cameras that the user or the recording states
    known_focal: set[int] = field(
        default_factory=set
    )  # numbers of the cameras whose focal length is stated, if only in EXIF
    unusable: dict[str, str] = field(default_factory=dict)  # reasons by name

    def require_enough(self, source: Path) -> None:
        """Raise ``InputError``, whose message begins with ``source``, if too few photos are readable."""
        if len(self.photos) < LEAST_PHOTOS:
            why = "".join(f" that can be read ({name}: {reason})" for name, reason in [*self.unusable.items()][:1])
            raise InputError(
                f"{amount(len(self.photos), 'photo')}{why}",
                where=source,
                expected=f"at least {LEAST_PHOTOS} of one scene, taken from different places",
            )


def list_photos(images: Capture, given: Camera | CameraSource | str | Path | None) -> PhotoSet:
    """Read the headers of photos, and group the photos by camera.

    Raises ``InputError`` for a ``given`` camera that does not fit the photos.
    """
    listed, numbers = PhotoSet(), dict[Any, int]()
    for number, shot in enumerate(images.shots, start=1):
        file = Path(str(shot.image))
        try:
            size, exif = read_header(file).size, read_exif(file)
        except InputError as error:
            listed.unusable[shot.name] = _without_file(error, file)
            continue
        exif_of_lens = replace(exif, orientation=UPRIGHT)
        source = photo_camera(shot.camera if given is None else given, file, shot.stem)
        camera = numbers.setdefault((size, exif_of_lens, source), len(numbers) + 1)
        photo = ListedPhoto(shot, file, number, size, reduced_size(*size, MATCHED_SIDE), exif, camera)
        listed.photos.append(photo)
        if camera in listed.cameras:
            continue
        first: Camera = Intrinsics.from_focal(1.2 * max(size), *size)  # as COLMAP assumes
        if source.is_given:
            first = source.find(file, Raster(*size)).camera
            listed.fixed.add(camera)
            listed.known_focal.add(camera)
        elif exif.has_focal_length:
            with contextlib.suppress(InputError):  # cropped after it was taken
                first = camera_from_exif(str(file), Raster(*size), exif_of_lens).intrinsics
                listed.known_focal.add(camera)
        listed.cameras[camera] = first.resized(*photo.reduced)
    return listed


def stored_name(number: int) -> str:
    """Return the name of a photo in the database, made from its number.

    The file name of a photo may contain spaces, which COLMAP's pair lists do not allow.
    """
    return f"{number:06d}"


def to_colmap(camera: Camera, number: int, pycolmap: Any) -> Any:
    """Convert a camera to one of pycolmap, which uses the same pixel convention.

    Raises ``InputError`` for a lens without a COLMAP model.
    """
    model, parameters = colmap_model(camera)
    return pycolmap.Camera(camera_id=number, model=model, width=camera.width, height=camera.height, params=parameters)


def to_sim3d(similarity: Similarity, pycolmap: Any) -> Any:
    """Convert a similarity to one of pycolmap."""
    T = similarity.T_target_source
    return pycolmap.Sim3d(similarity.scale, pycolmap.Rotation3d(T.rotation.numpy()), T.translation.numpy())


def write_cameras(database: Any, photos: PhotoSet, pycolmap: Any) -> None:
    """Write cameras and photos to an empty database. Cameras that are not fixed get one radial distortion coefficient."""
    with pycolmap.DatabaseTransaction(database):
        for number, known in photos.cameras.items():
            size = known.width, known.height
            camera = (
                to_colmap(known, number, pycolmap)
                if number in photos.fixed
                else pycolmap.Camera.create_from_model_name(number, "SIMPLE_RADIAL", known.pinhole.fx, *size)
            )
            camera.has_prior_focal_length = number in photos.known_focal
            database.write_camera(camera, use_camera_id=True)
            rig = pycolmap.Rig(rig_id=number)
            rig.add_ref_sensor(camera.sensor_id)
            database.write_rig(rig, use_rig_id=True)
        for photo in photos.photos:
            image = pycolmap.Image(name=stored_name(photo.number), camera_id=photo.camera, image_id=photo.number)
            database.write_image(image, use_image_id=True)
            frame = pycolmap.Frame(frame_id=photo.number, rig_id=photo.camera)
            frame.add_data_id(image.data_id)
            database.write_frame(frame, use_frame_id=True)


def write_keypoints(database: Any, photos: PhotoSet, pycolmap: Any) -> None:
    """Detect the keypoints that the database lacks; photos that cannot be decoded are moved to ``photos.unusable``.

    If the job is cancelled, the keypoints detected so far stay in the database.
    """
    count, total = counter("finding keypoints", "photos"), len(photos.photos)
    missing = [photo for photo in photos.photos if not database.exists_keypoints(photo.number)]
    with closing(map_tasks(_keypoints, ((photo,) for photo in missing))) as found:
        for done, (photo, keypoints) in enumerate(zip(missing, found, strict=True)):
            if isinstance(keypoints, InputError):
                photos.unusable[photo.shot.name] = _without_file(keypoints, photo.file)
                photos.photos.remove(photo)
            else:
                descriptors = pycolmap.FeatureDescriptors(
                    pycolmap.FeatureExtractorType.SIFT, keypoints.descriptors.numpy()
                )
                with pycolmap.DatabaseTransaction(database):
                    database.write_keypoints(photo.number, keypoints.pixels.float().numpy())
                    database.write_descriptors(photo.number, descriptors)
            count(total - len(missing) + done + 1, total)


def _keypoints(photo: ListedPhoto) -> Keypoints | InputError:
    """Return the keypoints of the downscaled photo, the largest first, without those on its transparent background; or the error."""
    try:
        rgb, alpha = read_compact_image(photo.file, size=photo.reduced)
    except InputError as error:
        return error
    keypoints = DETECTOR(rgb)
    keypoints = keypoints[keypoints.sizes.argsort(descending=True, stable=True)]
    if alpha is None:
        return keypoints
    columns, rows = keypoints.pixels.long().unbind(-1)
    inside = alpha[rows.clamp(0, alpha.shape[0] - 1), columns.clamp(0, alpha.shape[1] - 1)] > 0.5
    return keypoints[inside]


def _without_file(error: InputError, file: Path) -> str:
    """Return an error's message without the leading file path, which is shown next to the message anyway."""
    return str(error).removeprefix(f"{file}: ")
