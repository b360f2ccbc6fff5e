"""A photo's EXIF metadata: orientation, focal length and pixel size (EXIF 2.32, CIPA DC-008)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float, Shaped
from PIL.ExifTags import IFD, Base
from torch import Tensor

from bidnerf_core.io import open_image


@dataclass(frozen=True)
class Orientation:
    """The operations that turn the stored raster upright: mirror columns, mirror rows, then transpose."""

    mirrors_columns: bool = False
    mirrors_rows: bool = False
    transposes: bool = False

    @staticmethod
    def from_exif(code: int) -> Orientation:
        """Return the orientation for a code of EXIF tag 0x0112 (CIPA DC-008, table 6); unknown codes mean upright."""
        return Orientation(*CODES.get(code, (False, False, False)))

    def upright(self, image: Shaped[Tensor, "sh sw *channels"]) -> Shaped[Tensor, "h w *channels"]:
        """Turn a stored image upright."""
        axes = [axis for axis, flips in ((0, self.mirrors_rows), (1, self.mirrors_columns)) if flips]
        turned = image.flip(axes) if axes else image
        return turned.transpose(0, 1).contiguous() if self.transposes else turned

    @property
    def axes(self) -> Float[Tensor, "3 3"]:
        """The axes of the upright camera, by rows, in the frame of the camera of the stored image (x right, y down).

        It is the rotation ``R_upright_stored``, but its determinant is -1 for an image that is stored mirrored.
        """
        flips = torch.tensor([-1.0 if flips else 1.0 for flips in (self.mirrors_columns, self.mirrors_rows, False)])
        axes = torch.diag(flips.double())
        return axes[[1, 0, 2]] if self.transposes else axes

    def upright_size(self, width: int, height: int) -> tuple[int, int]:
        """Return the width and height of the upright image for a stored image of this size."""
        return (height, width) if self.transposes else (width, height)


UPRIGHT = Orientation()
CODES = {
    1: (False, False, False),
    2: (True, False, False),
    3: (True, True, False),
    4: (False, True, False),
    5: (False, False, True),
    6: (False, True, True),  # the camera was turned by 90 degrees: most portrait photos
    7: (True, True, True),
    8: (True, False, True),
}


LARGEST_EXIF = 2**20
"""Largest size (bytes) of tags that are parsed, which takes a hundred times as long as reading them; cameras write some 50,000."""


@dataclass(frozen=True)
class Exif:
    """The EXIF tags that describe the camera; None for a tag that is missing or implausible."""

    orientation: Orientation = UPRIGHT
    size: tuple[int, int] | None = None  # width and height of the stored image when the photo was taken
    equivalent_mm: float | None = None  # focal length with the same diagonal field of view on 35 mm film
    focal_mm: float | None = None
    # on the sensor, horizontally and vertically in the stored image
    pixels_per_mm: tuple[float, float] | None = None
    digital_zoom: float = 1.0

    @property
    def has_focal_length(self) -> bool:
        """Whether the tags determine a focal length in pixels."""
        return self.equivalent_mm is not None or None not in (self.focal_mm, self.pixels_per_mm)


def read_exif(path: Path) -> Exif:
    """Read the tags of an image file; damaged tags count as missing. Raises ``InputError`` if it is not an image."""
    with open_image(path) as image:
        if len(image.info.get("exif", b"")) > LARGEST_EXIF:
            return Exif()
        try:
            exif = image.getexif()
            tags: dict[int, Any] = {**exif, **exif.get_ifd(IFD.Exif)}
            # The length in millimetres of the resolution's unit: inch, centimetre, millimetre, micrometre.
            unit = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}.get(tags.get(Base.FocalPlaneResolutionUnit, 2))
            width, height = (_positive(tags.get(key)) for key in (Base.ExifImageWidth, Base.ExifImageHeight))
            x, y = (_positive(tags.get(k)) for k in (Base.FocalPlaneXResolution, Base.FocalPlaneYResolution))
            return Exif(
                Orientation.from_exif(tags.get(Base.Orientation, 1)),
                (int(width), int(height)) if width and height and min(width, height) >= 1 else None,
                _positive(tags.get(Base.FocalLengthIn35mmFilm)),
                _positive(tags.get(Base.FocalLength)),
                (x / unit, (y or x) / unit) if x and unit else None,
                _positive(tags.get(Base.DigitalZoomRatio)) or 1.0,  # 0 means that no digital zoom was used
            )
        except Exception:  # Pillow's parser may raise anything; EXIF is optional
            return Exif()


def _positive(value: Any) -> float | None:
    """Return a positive finite number, or None for anything else, such as the fraction 0/0."""
    try:
        number = float(value)
    except (TypeError, ValueError, ArithmeticError):
        return None
    return number if math.isfinite(number) and number > 0 else None
