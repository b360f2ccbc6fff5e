"""The sources of a photo's intrinsics: the user, a file, or the photo's own EXIF."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from bidnerf_core.camera.exif import Exif
from bidnerf_core.camera.intrinsics import Intrinsics, same_aspect
from bidnerf_core.camera.orientation import Orientation
from bidnerf_core.camera.records import camera_record
from bidnerf_core.camera.shapes import cameras_at_size, centre_crop_cameras, median_camera
from bidnerf_core.errors import InputError
from bidnerf_core.io.files import read_file
from bidnerf_core.io.json import parse_record

FILM_DIAGONAL = math.hypot(36.0, 24.0)
"""Millimetres; 35 mm-equivalent focal lengths refer to it (CIPA DCG-001)."""
LEAST_CROP = 0.5
"""Smallest share of the width or of the height at which a cropped photo is assumed to have kept its resolution."""
MIDDLE = "the principal point is assumed in the middle"
WAYS = "--camera FILE, --focal PX or --hfov DEG (camera=, focal=, hfov= in Python)"
COLMAP_MODELS: dict[str, tuple[int, ...]] = {
    # Indices of fx, fy, cx, cy and the distortion (in OpenCV's order) among the parameters; -1 is a coefficient of 0.
    "SIMPLE_PINHOLE": (0, 0, 1, 2),
    "PINHOLE": (0, 1, 2, 3),
    "SIMPLE_RADIAL": (0, 0, 1, 2, 3, -1, -1, -1),
    "RADIAL": (0, 0, 1, 2, 3, 4, -1, -1),
    "OPENCV": (0, 1, 2, 3, 4, 5, 6, 7),
    "FULL_OPENCV": (0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11),
}
"""Parameters of COLMAP's perspective models (https://colmap.github.io/cameras.html). Its pixel centres are at +0.5 as well."""
COLMAP_MODEL_IDS = {
    0: "SIMPLE_PINHOLE",
    1: "PINHOLE",
    2: "SIMPLE_RADIAL",
    3: "RADIAL",
    4: "OPENCV",
    6: "FULL_OPENCV",
}
"""The ids of these models in ``cameras.bin``."""


@dataclass(frozen=True)
class CameraSource:
    """The camera of an upright image, and a one-line description of its source."""

    intrinsics: Intrinsics
    description: str
    approximate: bool = False  # whether the focal length is a nominal one, as in EXIF


@dataclass(frozen=True)
class Raster:
    """The size of an image as stored in its file, and the orientation that turns it upright."""

    width: int
    height: int
    orientation: Orientation

    @property
    def size(self) -> tuple[int, int]:
        """Width and height as stored."""
        return self.width, self.height

    @property
    def upright_size(self) -> tuple[int, int]:
        """Width and height of the upright image."""
        return self.orientation.upright_size(self.width, self.height)

    def upright(self, camera: Intrinsics) -> Intrinsics | None:
        """Return a given camera for the upright image, or None where its aspect ratio fits neither orientation.

        A camera that fits the stored image is assumed to describe that (COLMAP ignores EXIF's orientation, too).
        """
        given = (camera.width, camera.height)
        if same_aspect(given, self.size):
            return camera.resized(*self.size).upright(self.orientation)
        return camera.resized(*self.upright_size) if same_aspect(given, self.upright_size) else None


def find_camera(
    where: str,
    raster: Raster,
    exif: Exif,
    camera: Intrinsics | str | Path | None = None,
    focal: float | None = None,
    hfov: float | None = None,
    assumed: Sequence[Intrinsics] = (),
) -> CameraSource:
    """Return the camera of an upright photo: ``camera``, ``focal`` or ``hfov`` where one is given, else that of EXIF.

    ``focal`` is in pixels of the stored image and ``hfov`` in degrees across the upright one. Where EXIF has no focal length,
    that of the ``assumed`` cameras, if there are any, is used. Raises ``InputError``, whose message begins with ``where``, if
    several are given, if none is known, and if the camera belongs to an image of another aspect ratio.
    """
    if sum(given is not None for given in (camera, focal, hfov)) > 1:
        raise InputError(f"{where}: several cameras are given, expected one of {WAYS}")
    size = raster.upright_size
    try:
        if focal is not None:
            return _described(Intrinsics.from_focal(focal, *size), f"focal length {focal:g} px as given")
        if hfov is not None:
            return _described(Intrinsics.from_hfov(hfov, *size), f"horizontal field of view {hfov:g} deg")
    except InputError as error:
        raise InputError(f"{where}: {error}") from error
    if camera is None:
        return replace(_found_camera(where, raster, exif, assumed), approximate=True)
    given, origin = (
        (camera, "camera as given")
        if isinstance(camera, Intrinsics)
        else (read_camera(Path(camera), size), f"camera of {camera}")
    )
    return _fitted(where, raster, given, origin)


def _found_camera(where: str, raster: Raster, exif: Exif, assumed: Sequence[Intrinsics]) -> CameraSource:
    """Return the camera from EXIF, or one of the ``assumed`` ones."""
    if exif.has_focal_length and assumed and exif.size and _is_cropped(raster, exif.size):
        return _camera_of_crop(where, raster, exif, exif.size)
    assumable = None if exif.has_focal_length else _assumed(raster, assumed)
    return assumable or camera_from_exif(where, raster, exif)


def _described(camera: Intrinsics, origin: str) -> CameraSource:
    return CameraSource(camera, f"{origin}: {_focal(camera)} ({MIDDLE})")


def _fitted(where: str, raster: Raster, given: Intrinsics, origin: str) -> CameraSource:
    fitted = raster.upright(given)
    if fitted is None:
        size = "x".join(map(str, raster.upright_size))
        raise InputError(
            f"{where}: image is {size}, its camera is for {given.width}x{given.height}; expected one of the same aspect ratio"
        )
    return CameraSource(fitted, f"{origin}: {_focal(fitted)}")


def _focal(camera: Intrinsics) -> str:
    return f"fx {camera.fx:.0f} px at {camera.width}x{camera.height}"


def camera_from_exif(where: str, raster: Raster, exif: Exif) -> CameraSource:
    """Return the camera that EXIF describes, accurate to a few percent; the lens is assumed to be free of distortion.

    Raises ``InputError`` where there is no focal length, and where the image was cropped after it was taken.
    """
    taken = exif.size
    if taken and _is_cropped(raster, taken):
        size = f"{raster.width}x{raster.height}"
        raise InputError(
            f"{where}: image is {size}, but was {taken[0]}x{taken[1]} when EXIF was written; give its camera: {WAYS}"
        )
    return _by_exif(where, raster, exif, raster.size)


def _camera_of_crop(where: str, raster: Raster, exif: Exif, taken: tuple[int, int]) -> CameraSource:
    """Return the camera of a photo that was cropped after EXIF was written, when its size was ``taken``.

    It is assumed to have kept its resolution, unless it is far smaller or larger: then it is taken for a resized centre crop.
    """
    ratio = max(raster.width / taken[0], raster.height / taken[1])
    fits = raster.width <= taken[0] and raster.height <= taken[1]
    scale = 1.0 if fits and ratio >= LEAST_CROP else ratio
    whole = (round(taken[0] * scale), round(taken[1] * scale))
    found = _by_exif(where, raster, exif, whole)
    return replace(found, description=f"{found.description}; a crop of a photo of {taken[0]}x{taken[1]}")


def _is_cropped(raster: Raster, taken: tuple[int, int]) -> bool:
    return not (same_aspect(taken, raster.size) or same_aspect(taken[::-1], raster.size))


def _by_exif(where: str, raster: Raster, exif: Exif, whole: tuple[int, int]) -> CameraSource:
    """Return the camera of an image that is, or was cropped from, one of the size ``whole``."""
    if exif.equivalent_mm is not None:
        focal = exif.equivalent_mm / FILM_DIAGONAL * math.hypot(*whole)
        return _from_focal(where, raster, focal, f"{exif.equivalent_mm:g} mm equivalent in EXIF")
    if exif.focal_mm is not None and exif.pixels_per_mm is not None:
        # ``pixels_per_mm`` refers to the image as it was taken.
        scale = max(whole) / max(exif.size) if exif.size else 1.0
        focal = exif.focal_mm * exif.pixels_per_mm[0] * exif.digital_zoom * scale
        zoom = f" and digital zoom {exif.digital_zoom:g}" if exif.digital_zoom != 1 else ""
        return _from_focal(where, raster, focal, f"{exif.focal_mm:g} mm, pixel size{zoom} in EXIF")
    raise InputError(
        f"{where}: no focal length in EXIF, expected a camera: {WAYS}, or assumed= with a map's cameras"
    )


def _assumed(raster: Raster, cameras: Sequence[Intrinsics]) -> CameraSource | None:
    """Return the camera with the median focal length among those of the same aspect ratio, or else among centre crops.

    Where it is not known to which side the camera was turned, only its focal length is used.
    """
    size = raster.upright_size
    whole = cameras_at_size(tuple(cameras), *size)
    groups = whole or centre_crop_cameras(tuple(cameras), *size)
    if not groups:
        return None
    likely, *others = (median_camera(group) for group in groups)
    origin = f"camera unknown, assumed to be that of {'' if whole else 'centre crops of '}the map's images"
    if not others:
        return CameraSource(likely, f"{origin}: {_focal(likely)}")
    return _described(Intrinsics.from_focal(math.sqrt(likely.fx * likely.fy), *size), origin)


def _from_focal(where: str, raster: Raster, focal: float, origin: str) -> CameraSource:
    try:
        return _described(Intrinsics.from_focal(focal, *raster.upright_size), origin)
    except InputError as error:
        raise InputError(f"{where}: EXIF: {error}; give its camera: {WAYS}") from error


def read_camera(path: Path, size: tuple[int, int]) -> Intrinsics:
    """Read the camera in the header of a ``transforms.json`` or ``cameras.json``, or in COLMAP's ``cameras.txt``.

    JSON without ``w`` and ``h`` describes an image of ``size`` (width, height). Raises ``InputError`` for other files, for
    lenses that are not perspective, and where ``cameras.txt`` holds several different cameras.
    """
    content = read_file(path, "a JSON file or COLMAP's cameras.txt")
    if content.lstrip(b"\xef\xbb\xbf \t\r\n")[:1] in (b"{", b"["):
        record = camera_record(parse_record(str(path), content))
        return record.intrinsics(record.width or size[0], record.height or size[1])
    cameras = _colmap_cameras(path, content)
    if len(set(cameras.values())) != 1:
        raise InputError(f"{path}: holds {len(cameras)} cameras, expected one; keep the line of this photo's")
    return next(iter(cameras.values()))


def read_text_cameras(path: Path) -> dict[int, Intrinsics]:
    """Read COLMAP's ``cameras.txt`` and return its cameras by their ids. Raises ``InputError``."""
    return _colmap_cameras(path, read_file(path, "COLMAP's cameras.txt"))


def _colmap_cameras(path: Path, content: bytes) -> dict[int, Intrinsics]:
    try:
        lines = [line.partition("#")[0].split() for line in content.decode("utf-8-sig").splitlines()]
    except UnicodeDecodeError as error:
        raise InputError(
            f"{path}: neither JSON nor text, expected transforms.json or cameras.txt "
            "(COLMAP's model_converter makes it of cameras.bin)"
        ) from error
    found: dict[int, Intrinsics] = {}
    for number, words in enumerate(lines, start=1):
        if words:
            key, camera = _text_camera(f"{path}: line {number}", words)
            if found.setdefault(key, camera) != camera:
                raise InputError(f"{path}: line {number}: camera {key} again, expected each id once")
    return found


def _text_camera(where: str, words: Sequence[str]) -> tuple[int, Intrinsics]:
    """Read ``CAMERA_ID MODEL WIDTH HEIGHT PARAMS...``."""
    expected = "expected CAMERA_ID MODEL WIDTH HEIGHT and parameters"
    if len(words) < 5:
        raise InputError(f"{where} has {len(words)} entries, {expected}")
    if words[1] not in COLMAP_MODELS:
        raise InputError(f"{where}: camera model {words[1]}, expected one of {', '.join(COLMAP_MODELS)}")
    try:
        number, width, height = int(words[0]), int(words[2]), int(words[3])
        parameters = [float(word) for word in words[4:]]
    except ValueError as error:
        raise InputError(f"{where}: {error}, {expected}") from error
    return number, colmap_camera(where, words[1], width, height, parameters)


def colmap_parameters(model: str) -> int:
    """Return the number of parameters of one of ``COLMAP_MODELS``."""
    return max(COLMAP_MODELS[model]) + 1


def colmap_camera(where: str, model: str, width: int, height: int, parameters: Sequence[float]) -> Intrinsics:
    """Return a camera of one of ``COLMAP_MODELS``. Raises ``InputError``, whose message begins with ``where``."""
    if len(parameters) != colmap_parameters(model):
        raise InputError(
            f"{where}: {model} has {len(parameters)} parameters, expected {colmap_parameters(model)}"
        )
    fx, fy, cx, cy, *lens = (0.0 if place < 0 else parameters[place] for place in COLMAP_MODELS[model])
    try:
        return Intrinsics(fx, fy, cx, cy, width, height, tuple(lens) if any(lens) else ())
    except InputError as error:
        raise InputError(f"{where}: {error}") from error
