"""Where a photo's intrinsics come from: the user, a file, or the photo's EXIF."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

from jaxtyping import Shaped
from torch import Tensor

from bidnerf_core.camera.exif import UPRIGHT, Exif, Orientation
from bidnerf_core.camera.files import read_camera
from bidnerf_core.camera.intrinsics import Intrinsics, cameras_at_size, reduced_size, same_aspect
from bidnerf_core.camera.lenses import Camera, Lens
from bidnerf_core.errors import InputError, errors_in
from bidnerf_core.io import require_existing

CameraKind = TypeVar("CameraKind", Intrinsics, Lens, Camera)
WAYS = "`camera` (a file), `focal` (pixels) or `hfov` (degrees)"


@dataclass(frozen=True)
class ResolvedCamera:
    """The camera of an upright image (the lens, if the image is resampled), and a one-line description of its source."""

    camera: Camera
    description: str
    approximate: bool = False  # whether the focal length is only nominal, as in EXIF

    @property
    def intrinsics(self) -> Intrinsics:
        """The pinhole camera of the image after any resampling."""
        return self.camera.pinhole

    def at_most(self, largest: int | None) -> ResolvedCamera:
        """Return the camera of the image reduced to at most ``largest`` pixels along its longer side, see ``checked_side``."""
        side = check_side(largest)
        if side is None or max(self.camera.width, self.camera.height) <= side:
            return self
        return replace(self, camera=self.camera.resized(*reduced_size(self.camera.width, self.camera.height, side)))


def check_side(largest: int | None) -> int | None:
    """Return ``largest``, a limit on an image's longer side (pixels). Raises ``InputError`` unless it is a positive integer."""
    if largest is not None and (isinstance(largest, bool) or not isinstance(largest, int) or largest < 1):
        raise InputError(f"largest is {largest!r}", expected="a positive whole number of pixels")
    return largest


@dataclass(frozen=True)
class Raster:
    """The size of an image as stored in its file, and the orientation that turns it upright."""

    width: int
    height: int
    orientation: Orientation = UPRIGHT

    @property
    def size(self) -> tuple[int, int]:
        """Width and height as stored."""
        return self.width, self.height

    @property
    def upright_size(self) -> tuple[int, int]:
        """Width and height of the upright image."""
        return self.orientation.upright_size(self.width, self.height)

    def upright(self, camera: CameraKind) -> CameraKind | None:
        """Return ``camera`` adapted to the upright image, or None if its aspect ratio fits neither orientation.

        A camera that fits the stored image is assumed to describe that image (COLMAP ignores the EXIF
        orientation too).
        """
        given = (camera.width, camera.height)
        if same_aspect(given, self.size):
            return camera.resized(*self.size).upright(self.orientation)
        return camera.resized(*self.upright_size) if same_aspect(given, self.upright_size) else None

    def turn(self, image: Shaped[Tensor, "mh mw"], what: str, where: object = None) -> Shaped[Tensor, "h w"]:
        """Return the image's mask or depth upright, at its own resolution; it is turned if it has the stored image's aspect ratio.

        Raises ``InputError``, which names ``what`` and ``where``, if the aspect ratio fits neither orientation.
        """
        given = image.shape[1], image.shape[0]
        if same_aspect(given, self.size):
            return self.orientation.upright(image)
        if same_aspect(given, self.upright_size):
            return image
        size = "x".join(map(str, self.upright_size))
        raise InputError(
            f"{what} is {given[0]}x{given[1]}, but its image is {size};", where=where, expected="the same aspect ratio"
        )


@dataclass(frozen=True)
class CameraSource:
    """What is known about the camera of a set of images, apart from their EXIF.

    At most one of ``camera`` (intrinsics, or a file that holds them), ``focal`` and ``hfov`` may be given.
    ``assumed`` holds candidate cameras for images whose focal length is unknown.
    """

    camera: Camera | str | Path | None = None
    focal: float | None = None  # pixels of the stored image
    hfov: float | None = None  # degrees across the upright image
    assumed: tuple[Intrinsics, ...] = ()

    @property
    def is_given(self) -> bool:
        """Whether the camera is given, rather than found in EXIF or assumed."""
        return any(given is not None for given in (self.camera, self.focal, self.hfov))

    def find(self, where: Path | str, raster: Raster, exif: Exif | None = None) -> ResolvedCamera:
        """Return the camera of an upright image: the given one, else the one in EXIF, else one of the ``assumed`` ones.

        Raises ``InputError``, whose message begins with ``where``, if several cameras are given, if none is
        known, and if the camera has another aspect ratio than the image.
        """
        camera, focal, hfov, size = self.camera, self.focal, self.hfov, raster.upright_size
        exif = exif or Exif()
        if sum(given is not None for given in (camera, focal, hfov)) > 1:
            raise InputError("several cameras are given", where=where, expected=f"one of {WAYS}")
        with errors_in(where):
            if focal is not None:
                return _describe(Intrinsics.from_focal(focal, *size), f"focal length {focal:g} px, as given")
            if hfov is not None:
                return _describe(Intrinsics.from_hfov(hfov, *size), f"horizontal field of view {hfov:g} deg")
        if camera is None:
            resolved = None if exif.has_focal_length else _assume(raster, self.assumed)
            # Where a crop lies in its photo is unknown. Only landmarks can correct its principal point, and there are
            # ``assumed`` cameras only where landmarks are matched.
            resolved = resolved or camera_from_exif(str(where), raster, exif, may_be_cropped=bool(self.assumed))
            return replace(resolved, approximate=True)
        if isinstance(camera, Intrinsics | Lens):
            return _fit(str(where), raster, camera, "camera as given")
        if not isinstance(camera, str | Path):
            raise InputError(
                f"camera is a {type(camera).__name__}",
                where=where,
                expected="Intrinsics or the path of a camera file"
                + (
                    "; Intrinsics.from_opencv(K, distortion, (width, height)) makes them from a matrix"
                    if getattr(camera, "shape", None) == (3, 3)
                    else ""
                ),
            )
        return _fit(str(where), raster, read_camera(Path(camera), size, str(where)), f"camera of {camera}")


def folder_camera(
    folder: Path,
    given: Camera | Path | None,
    published: Intrinsics | None,
    unknown: str = "",
    ways: str = "a file",
    is_needed: bool = True,
) -> CameraSource:
    """Return the single camera of a recording whose format stores none.

    In order of precedence, it is the ``given`` camera (intrinsics or a file), the file ``camera.json`` or ``cameras.txt``
    in ``folder``, or the ``published`` camera of the format. Raises ``InputError`` if there is none, with the reason
    ``unknown`` and the ``ways`` to give one, unless the camera is not needed, and for a given file that does not exist.
    """
    require_existing(given if isinstance(given, Path) else None, expected=f"the camera of {folder}: {ways}")
    beside = next((file for name in ("camera.json", "cameras.txt") if (file := folder / name).is_file()), None)
    camera = given or beside or published
    if camera is None and is_needed:
        raise InputError(
            f"{unknown};",
            where=folder,
            expected=f"its camera: camera.json or cameras.txt in the folder, or `camera` with {ways}",
        )
    return CameraSource(camera)


def _describe(camera: Intrinsics, origin: str) -> ResolvedCamera:
    return ResolvedCamera(
        camera, f"{origin}: {camera.sentence} (the principal point is assumed to be the image centre)"
    )


def _fit(where: str, raster: Raster, given: Camera, origin: str) -> ResolvedCamera:
    fitted = raster.upright(given)
    if fitted is None:
        size = "x".join(map(str, raster.upright_size))
        raise InputError(
            f"image is {size}, but its camera is for {given.width}x{given.height}",
            where=where,
            expected="images that are not turned by a quarter against their cameras: export them as stored"
            if same_aspect((given.height, given.width), raster.size)
            else "one with the same aspect ratio",
        )
    return ResolvedCamera(fitted, f"{origin}: {fitted.sentence}")


def camera_from_exif(where: str, raster: Raster, exif: Exif, may_be_cropped: bool = False) -> ResolvedCamera:
    """Return the camera that EXIF describes, accurate to a few percent and assumed to be free of distortion.

    If ``may_be_cropped``, an image cropped after it was taken is assumed to have kept its resolution unless its size
    differs by more than half; then it is treated as a resized centre crop. Raises ``InputError`` if there is no focal length,
    and for any other cropped image.
    """
    taken, whole = exif.size, raster.size  # ``whole`` is the size before the image was cropped
    part = ""
    if taken and not (same_aspect(taken, raster.size) or same_aspect(taken[::-1], raster.size)):
        if not may_be_cropped:
            raise InputError(
                f"image is {raster.width}x{raster.height}, but was {taken[0]}x{taken[1]} when EXIF was written; give its"
                f" camera: {WAYS}",
                where=where,
            )
        ratio = max(raster.width / taken[0], raster.height / taken[1])
        fits = raster.width <= taken[0] and raster.height <= taken[1]
        scale = 1.0 if fits and ratio >= 0.5 else ratio
        whole = round(taken[0] * scale), round(taken[1] * scale)
        part = f"; cropped from a photo of {taken[0]}x{taken[1]}"
    if exif.equivalent_mm is not None:
        focal = exif.equivalent_mm / math.hypot(36, 24) * math.hypot(*whole)  # of 35 mm film (CIPA DCG-001)
        origin = f"{exif.equivalent_mm:g} mm equivalent in EXIF"
    elif exif.focal_mm is not None and exif.pixels_per_mm is not None:
        # ``pixels_per_mm`` refers to the image as it was taken.
        scale = max(whole) / max(taken) if taken else 1.0
        focal = exif.focal_mm * exif.pixels_per_mm[0] * exif.digital_zoom * scale
        zoom = f" and digital zoom {exif.digital_zoom:g}" if exif.digital_zoom != 1 else ""
        origin = f"{exif.focal_mm:g} mm, pixel size{zoom} in EXIF"
    else:
        raise InputError("no focal length in EXIF", where=where, expected=f"a camera: {WAYS}")
    try:
        resolved = _describe(Intrinsics.from_focal(focal, *raster.upright_size), origin)
    except InputError as error:
        raise InputError(f"EXIF: {error}; give its camera: {WAYS}", where=where) from error
    return replace(resolved, description=resolved.description + part)


def _assume(raster: Raster, cameras: Sequence[Intrinsics]) -> ResolvedCamera | None:
    """Return the camera with the median focal length among the cameras of the same size, or else of the same aspect
    ratio, or else among centre crops.

    If it is unknown to which side the camera was turned, only the focal length is used.
    """
    size = raster.upright_size
    exact = tuple(camera for camera in cameras if (camera.width, camera.height) == size)
    whole = cameras_at_size(exact or tuple(cameras), *size)
    groups = whole or cameras_at_size(tuple(cameras), *size, "cropped")
    if not groups:
        return None
    likely, *others = (sorted(group, key=lambda c: c.fx)[(len(group) - 1) // 2] for group in groups)
    origin = f"camera unknown, assumed to be that of {'' if whole else 'centre crops of '}the map's images"
    if not others:
        return ResolvedCamera(likely, f"{origin}: {likely.sentence}")
    return _describe(Intrinsics.from_focal(math.sqrt(likely.fx * likely.fy), *size), origin)
