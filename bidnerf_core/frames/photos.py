"""A user's own photo: upright pixels, their camera, and depth of the same size."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from jaxtyping import Float
from torch import Tensor

from bidnerf_core.camera import Camera, CameraSource, FoundCamera, Intrinsics, Raster, read_exif, same_aspect
from bidnerf_core.depth import DepthCamera, DepthImage, read_depth_image
from bidnerf_core.errors import InputError
from bidnerf_core.io import (
    HEIF_SUFFIXES,
    IMAGE_SUFFIXES,
    Background,
    background_colour,
    looks_like_image,
    read_header,
    read_image,
    resampled,
)

DEPTH_STEM = ".depth"
"""``NAME.depth.png`` is the depth of ``NAME.png``, as written by ``bidnerf render``."""


@dataclass(frozen=True, eq=False)
class Photo:
    """An upright image in [0, 1] over its background, its camera, its depth, and the assumptions made."""

    rgb: Float[Tensor, "h w 3"]
    alpha: Float[Tensor, "h w"] | None  # 1 where the scene covers the pixel
    camera: FoundCamera
    depth: Float[Tensor, "h w"] | None  # planar z in metres, 0 where nothing was measured
    remark: str | None  # one line on the assumptions made about depth
    raster: Raster  # of the image as stored


def read_photo(
    path: Path,
    camera: CameraSource,
    *,
    depth: Path | None = None,
    depth_unit: float | None = None,
    sensor: DepthCamera | None = None,
    background: Background = (0.0, 0.0, 0.0),
    largest: int | None = None,
) -> Photo:
    """Read an image file and find its camera as ``Frame.open`` does, with the same errors.

    Depth is registered to the image from ``sensor``, if given.
    """
    colour_behind = background_colour(background)
    header, exif = read_header(path), read_exif(path)
    raster = Raster(header.width, header.height, exif.orientation)
    found = camera.find(path, raster, exif)
    measured = None if depth is None else read_depth_image(depth, depth_unit)
    found = found.at_most(largest)
    size = (found.camera.width, found.camera.height)
    rgb, alpha = read_image(path, colour_behind, exif.orientation.upright_size(*size))
    rgb = exif.orientation.upright(rgb)
    alpha = None if alpha is None else exif.orientation.upright(alpha)
    if measured is None or depth is None:
        return Photo(rgb, alpha, found, None, None, raster)
    fitted = (
        fit_depth(measured, raster, size, f"{depth}: depth")
        if sensor is None
        else sensor.registered(measured.metres, pinhole_of(found.camera, depth), depth)
    )
    return Photo(rgb, alpha, found, fitted, measured.remark(depth_unit is None), raster)


def pinhole_of(camera: Camera, depth: Path) -> Intrinsics:
    """Return a camera to which depth can be registered. Raises ``InputError`` for a lens whose images are resampled."""
    if not isinstance(camera, Intrinsics):
        raise InputError(
            f"depth cannot be registered to {camera.sentence}", where=depth, expected="undistorted images"
        )
    return camera


def fit_depth(measured: DepthImage, raster: Raster, size: tuple[int, int], what: str) -> Float[Tensor, "h w"]:
    """Turn a depth image upright and resize it to ``size`` (width, height) by taking the nearest measurement.

    Depth whose shape fits the stored image is turned with it. Raises ``InputError``, whose message begins
    with ``what``, if the aspect ratio is that of another image.
    """
    metres = measured.metres
    given = (metres.shape[1], metres.shape[0])
    if same_aspect(given, raster.size):
        metres = raster.orientation.upright(metres)
    elif not same_aspect(given, raster.upright_size):
        expected = "x".join(map(str, raster.upright_size))
        raise InputError(
            f"{what} is {given[0]}x{given[1]}, but its image is {expected};", expected="the same aspect ratio"
        )
    return metres if tuple(metres.shape) == size[::-1] else resampled(metres, *size)


def photos_in(folder: str | Path) -> tuple[list[Path], list[Path]]:
    """Return the image files and the other files of a folder, both in natural order (``2.jpg`` before
    ``10.jpg``).

    Depth images (``NAME.depth.png``), hidden files and files that are not images by extension or first bytes
    are among the others; subfolders are left out. Raises ``InputError`` unless ``folder`` is a readable
    folder.
    """
    try:
        files = sorted(
            (file for file in Path(folder).iterdir() if file.is_file()),
            key=lambda file: natural_order(file.name),
        )
    except FileNotFoundError as error:
        raise InputError("no such folder", where=folder) from error
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise InputError(reason, where=folder, expected="a folder of photos") from error
    photos = [file for file in files if _is_photo(file)]
    return photos, [file for file in files if not _is_photo(file)]


def _is_photo(file: Path) -> bool:
    hidden = file.name.startswith(".")  # such as macOS's "._IMG_1.JPG"
    if hidden or file.stem.endswith(DEPTH_STEM):
        return False
    return file.suffix.lower() in (*IMAGE_SUFFIXES, *HEIF_SUFFIXES) or looks_like_image(file)


def natural_order(name: str) -> list[tuple[int, str]]:
    """Return a sort key that compares digits as numbers."""
    parts = re.split(r"(\d+)", name.lower())
    return [(int(part), "") if place % 2 else (-1, part) for place, part in enumerate(parts)]
