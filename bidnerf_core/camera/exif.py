"""A photo's EXIF metadata: orientation, focal length and pixel size (EXIF 2.32, CIPA DC-008)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from PIL.ExifTags import IFD, Base

from bidnerf_core.camera.orientation import UPRIGHT, Orientation
from bidnerf_core.io import open_image

MILLIMETRES = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
"""Length of the unit of FocalPlaneResolutionUnit: inch, centimetre, millimetre, micrometre."""


@dataclass(frozen=True)
class Exif:
    """The tags that describe the camera; None for a tag that is missing or implausible."""

    orientation: Orientation = UPRIGHT
    size: tuple[int, int] | None = None  # width and height of the stored image when the photo was taken
    equivalent_mm: float | None = None  # focal length with the same diagonal field of view on 35 mm film
    focal_mm: float | None = None
    pixels_per_mm: tuple[float, float] | None = (
        None  # on the sensor, along the columns and rows of the stored image
    )
    digital_zoom: float = 1.0

    @property
    def has_focal_length(self) -> bool:
        """Whether the tags give a focal length in pixels."""
        return self.equivalent_mm is not None or None not in (self.focal_mm, self.pixels_per_mm)


def read_exif(path: Path) -> Exif:
    """Read the tags of an image file; damaged tags count as missing. Raises ``InputError`` if it is not an
    image.
    """
    with open_image(path) as image:
        try:
            tags = image.getexif()
            return _exif({**tags, **tags.get_ifd(IFD.Exif)})
        except Exception:  # Pillow's parser may raise anything; EXIF is optional
            return Exif()


def _exif(tags: Mapping[int, Any]) -> Exif:
    code = tags.get(Base.Orientation, 1)
    return Exif(
        Orientation.from_exif(code) if isinstance(code, int) else UPRIGHT,
        _size(tags),
        _positive(tags.get(Base.FocalLengthIn35mmFilm)),
        _positive(tags.get(Base.FocalLength)),
        _resolution(tags),
        _positive(tags.get(Base.DigitalZoomRatio)) or 1.0,  # 0 means that no digital zoom was used
    )


def _size(tags: Mapping[int, Any]) -> tuple[int, int] | None:
    width, height = (_positive(tags.get(tag)) for tag in (Base.ExifImageWidth, Base.ExifImageHeight))
    return (int(width), int(height)) if width and height and min(width, height) >= 1 else None


def _resolution(tags: Mapping[int, Any]) -> tuple[float, float] | None:
    unit = tags.get(Base.FocalPlaneResolutionUnit, 2)
    x, y = (_positive(tags.get(tag)) for tag in (Base.FocalPlaneXResolution, Base.FocalPlaneYResolution))
    if x is None or unit not in MILLIMETRES:
        return None
    return x / MILLIMETRES[unit], (y or x) / MILLIMETRES[unit]


def _positive(value: Any) -> float | None:
    """Return a positive finite number, or None for anything else, such as the fraction 0/0."""
    try:
        number = float(value)
    except (TypeError, ValueError, ArithmeticError):
        return None
    return number if math.isfinite(number) and number > 0 else None
