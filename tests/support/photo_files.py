"""Photos as a camera writes them, with EXIF, for tests."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from PIL.ExifTags import GPS, IFD, Base


def write_photo(
    path: Path, pixels: np.ndarray, orientation: int = 1, gps: tuple[float, float, float] | None = None, **tags: Any
) -> Path:
    """Write an image with EXIF tags by their names in ``PIL.ExifTags.Base``, and a position: latitude, longitude and altitude."""
    exif = Image.Exif()
    exif[Base.Orientation] = orientation  # without a tag of its own, Pillow writes no EXIF at all
    inner = exif.get_ifd(IFD.Exif)
    for name, value in tags.items():
        inner[Base[name]] = value
    if gps is not None:
        latitude, longitude, altitude = gps
        position = exif.get_ifd(IFD.GPSInfo)
        position[GPS.GPSLatitudeRef], position[GPS.GPSLongitudeRef] = "NS"[latitude < 0], "EW"[longitude < 0]
        position[GPS.GPSLatitude], position[GPS.GPSLongitude] = (
            (int(part := abs(angle)), int(part * 60 % 60), part * 3600 % 60) for angle in (latitude, longitude)
        )
        position[GPS.GPSAltitude] = altitude
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path, exif=exif)
    return path


def noise(height: int, width: int, channels: int = 3, seed: int = 0) -> np.ndarray:
    """Pixels of which no two are alike, as good as."""
    return np.random.default_rng(seed).integers(0, 256, (height, width, channels), dtype=np.uint8)
