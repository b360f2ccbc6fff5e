"""Arrays and images as JSON values: base64 of little-endian numbers, and data URLs."""

from __future__ import annotations

import base64
import io
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image
from torch import Tensor

from bidnerf_core.results import as_picture

JPEG_QUALITY = 85


Json: TypeAlias = dict[str, Any]
"""A part of the page's state, which its scripts read. The function that returns it says what it holds."""


def packed(array: np.ndarray) -> Json:
    """Return the ``type`` and ``shape`` of an array of bytes, 16-bit integers or floats, and its numbers in ``base64``."""
    kinds = {"i1": "int8", "u1": "uint8", "u2": "uint16", "f4": "float32", "f8": "float32"}
    kind = kinds[array.dtype.str[1:]]
    content = np.ascontiguousarray(array, dtype=np.dtype(kind).newbyteorder("<")).tobytes()
    return {"type": kind, "shape": array.shape, "base64": base64.b64encode(content).decode()}


def packed_points(points: Float[Tensor, "n 3"]) -> Json:
    """Return points as 16-bit integers, ``places``: a coordinate is ``lower + place / 65535 * size``."""
    values = points.detach().cpu().double().numpy()
    lower = values.min(0) if len(values) else np.zeros(3)
    size = max(float((values - lower).max(initial=0.0)), 1e-9)
    places = ((values - lower) / size * 65535 + 0.5).astype(np.uint16)
    return {"lower": lower.tolist(), "size": size, "places": packed(places)}


def packed_colours(rgb: Float[Tensor, "n 3"]) -> Json:
    """Return colours in [0, 1] as bytes."""
    return packed((rgb.detach().cpu().float().clamp(0, 1).numpy() * 255 + 0.5).astype(np.uint8))


def jpeg(image: Float[Tensor, "h w 3"] | UInt8[np.ndarray, "h w 3"], quality: int = JPEG_QUALITY) -> bytes:
    """Return an image as the bytes of a JPEG file."""
    file = io.BytesIO()
    Image.fromarray(as_picture(image)).save(file, "JPEG", quality=quality)
    return file.getvalue()


def photograph(image: Float[Tensor, "h w 3"], quality: int = JPEG_QUALITY) -> Json:
    """Return an image as the data ``url`` of a JPEG, with its ``width`` and ``height`` in pixels."""
    url = "data:image/jpeg;base64," + base64.b64encode(jpeg(image, quality)).decode()
    return {"url": url, "width": int(image.shape[1]), "height": int(image.shape[0])}


def drawing(image: UInt8[np.ndarray, "h w channels"]) -> Json:
    """Return an image, which may have an alpha channel, as ``photograph`` does but as a PNG."""
    file = io.BytesIO()
    Image.fromarray(image).save(file, "PNG", optimize=True)
    url = "data:image/png;base64," + base64.b64encode(file.getvalue()).decode()
    return {"url": url, "width": image.shape[1], "height": image.shape[0]}
