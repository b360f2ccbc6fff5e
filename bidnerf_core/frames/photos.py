"""Photo files in a folder, and depth images resized to their photos."""

from __future__ import annotations

import re
from pathlib import Path

from jaxtyping import Float
from torch import Tensor

from bidnerf_core.camera import Camera, Intrinsics, Raster
from bidnerf_core.depth import DepthImage
from bidnerf_core.errors import InputError
from bidnerf_core.io import (
    HEIF_SUFFIXES,
    IMAGE_SUFFIXES,
    looks_like_image,
    resample_nearest,
)

DEPTH_STEM = ".depth"
"""``NAME.depth.png`` is the depth of ``NAME.png``, as written by ``bidnerf render``."""


def pinhole_of(camera: Camera, depth: Path) -> Intrinsics:
    """Return ``camera`` if depth can be registered to it. Raises ``InputError`` for a lens whose images are resampled."""
    if not isinstance(camera, Intrinsics):
        raise InputError(f"depth cannot be registered to {camera.sentence}", where=depth, expected="undistorted images")
    return camera


def fit_depth(measured: DepthImage, raster: Raster, size: tuple[int, int], what: str) -> Float[Tensor, "h w"]:
    """Turn a depth image upright and resize it to ``size`` (width, height) by taking the nearest measurement.

    Depth whose shape fits the stored image is turned with it. Raises ``InputError``, whose message begins
    with ``what``, if the aspect ratio differs from the image's.
    """
    metres = raster.turn(measured.metres, what)
    return metres if tuple(metres.shape) == size[::-1] else resample_nearest(metres, *size)


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
        raise InputError((error.strerror or str(error)).lower(), where=folder, expected="a folder of photos") from error
    return [file for file in files if _is_photo(file)], [file for file in files if not _is_photo(file)]


def _is_photo(file: Path) -> bool:
    hidden = file.name.startswith(".")  # such as macOS's "._IMG_1.JPG"
    if hidden or file.stem.endswith(DEPTH_STEM):
        return False
    return file.suffix.lower() in (*IMAGE_SUFFIXES, *HEIF_SUFFIXES) or looks_like_image(file)


def natural_order(name: str) -> list[tuple[int, str]]:
    """Return a sort key that ignores case and compares runs of digits as numbers."""
    parts = re.split(r"(\d+)", name.lower())
    # No file name has more digits, but a name in a file may have more than Python converts.
    return [(int(part[:255]), "") if number % 2 else (-1, part) for number, part in enumerate(parts)]
