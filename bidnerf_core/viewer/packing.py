"""Arrays and images as JSON values: base64 of little-endian numbers, and data URLs."""

from __future__ import annotations

import base64
import io
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image
from torch import Tensor

from bidnerf_core.results import as_picture

JPEG_QUALITY = 85


@dataclass(frozen=True)
class Packed:
    """An array: its numbers in base64, row by row."""

    type: Literal["int8", "uint8", "uint16", "float32"]
    shape: tuple[int, ...]
    base64: str


@dataclass(frozen=True)
class PackedPoints:
    """Points as 16-bit integers: a coordinate is ``lower + integer / 65535 * size``."""

    lower: tuple[float, float, float]
    size: float
    places: Packed  # uint16 (n, 3)


@dataclass(frozen=True)
class Picture:
    """An image as a data URL, with its size in pixels."""

    url: str
    width: int
    height: int


def packed(array: np.ndarray) -> Packed:
    """Return an array of bytes, 16-bit integers or floats as JSON values."""
    kinds = {"i1": "int8", "u1": "uint8", "u2": "uint16", "f4": "float32", "f8": "float32"}
    kind = kinds[array.dtype.str[1:]]
    content = np.ascontiguousarray(array, dtype=np.dtype(kind).newbyteorder("<")).tobytes()
    return Packed(kind, array.shape, base64.b64encode(content).decode())  # type: ignore[arg-type]


def packed_points(points: Float[Tensor, "n 3"]) -> PackedPoints:
    """Return points with a precision of 1/65535 of their extent."""
    values = points.detach().cpu().double().numpy()
    if not len(values):
        return PackedPoints((0.0, 0.0, 0.0), 1.0, packed(np.zeros((0, 3), np.uint16)))
    lower = values.min(0)
    size = max(float((values.max(0) - lower).max()), 1e-9)
    places = ((values - lower) / size * 65535 + 0.5).astype(np.uint16)
    x, y, z = lower.tolist()
    return PackedPoints((x, y, z), size, packed(places))


def packed_colours(rgb: Float[Tensor, "n 3"]) -> Packed:
    """Return colours in [0, 1] as bytes."""
    return packed((rgb.detach().cpu().float().clamp(0, 1).numpy() * 255 + 0.5).astype(np.uint8))


def jpeg(image: Float[Tensor, "h w 3"] | UInt8[np.ndarray, "h w 3"], quality: int = JPEG_QUALITY) -> bytes:
    """Return an image as the bytes of a JPEG file."""
    file = io.BytesIO()
    Image.fromarray(as_picture(image)).save(file, "JPEG", quality=quality)
    return file.getvalue()


def photograph(image: Float[Tensor, "h w 3"], quality: int = JPEG_QUALITY) -> Picture:
    """Return an image as a JPEG in a data URL."""
    url = "data:image/jpeg;base64," + base64.b64encode(jpeg(image, quality)).decode()
    return Picture(url, int(image.shape[1]), int(image.shape[0]))


def drawing(image: UInt8[np.ndarray, "h w channels"]) -> Picture:
    """Return an image, which may have an alpha channel, as a PNG in a data URL."""
    file = io.BytesIO()
    Image.fromarray(image).save(file, "PNG", optimize=True)
    url = "data:image/png;base64," + base64.b64encode(file.getvalue()).decode()
    return Picture(url, image.shape[1], image.shape[0])
