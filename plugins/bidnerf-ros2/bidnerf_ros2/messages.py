"""Conversion of ``sensor_msgs`` images and cameras to bidnerf's; pure functions that need no ROS.

They only read attributes, so they accept messages of ROS itself and those read by ``rosbags``.
"""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
from PIL import Image

from bidnerf_core.camera import Intrinsics
from bidnerf_core.errors import InputError
from bidnerf_core.frames import Frame
from bidnerf_core.io import PackedFile, open_image

COLOURS = {
    "rgb8": (0, 1, 2),
    "bgr8": (2, 1, 0),
    "rgba8": (0, 1, 2),
    "bgra8": (2, 1, 0),
    "mono8": (0,),
    "8UC1": (0,),
}
"""The channels in the order red, green, blue; alpha is ignored. ``8UC3`` does not specify its order."""
DEPTHS = {"16UC1": (np.uint16, 0.001), "mono16": (np.uint16, 0.001), "32FC1": (np.float32, 1.0)}
"""Type, and metres per step (REP 118)."""
BYTES = {"rgba8": 4, "bgra8": 4, "rgb8": 3, "bgr8": 3}
COMPRESSED_DEPTH = struct.Struct("<iff")
"""The header of ``compressed_depth_image_transport``: a format, and the two parameters of its inverse-depth
quantization."""


def intrinsics(info: Any, rectified: bool = False) -> Intrinsics:
    """Return the camera of a ``CameraInfo`` (ROS 1 or 2) after binning and within its region of interest.

    ROS measures pixels from the centre of the first one, bidnerf from its corner. ``rectified``: whether the
    images are free of distortion (topics ``image_rect``); their camera is the matrix P. Raises ``InputError``
    for fisheye lenses and uncalibrated cameras.
    """
    k, d, p = (_values(info, name) for name in "kdp")
    fx, fy, cx, cy = (p[0], p[5], p[2], p[6]) if rectified else (k[0], k[4], k[2], k[5])
    if not fx > 0:
        raise InputError("the camera info has a focal length of 0", expected="a calibrated camera")
    model = info.distortion_model
    if not rectified and any(d) and model not in ("plumb_bob", "rational_polynomial"):
        raise InputError(
            f"distortion model {model!r}", expected="plumb_bob or rational_polynomial; or rectify the images"
        )
    lens = () if rectified or not any(d) else tuple(d)
    bin_x, bin_y, roi = info.binning_x or 1, info.binning_y or 1, info.roi
    width, height = roi.width or info.width, roi.height or info.height
    return Intrinsics(
        fx / bin_x,
        fy / bin_y,
        (cx + 0.5 - roi.x_offset) / bin_x,
        (cy + 0.5 - roi.y_offset) / bin_y,
        int(width) // bin_x,
        int(height) // bin_y,
        lens,
    )


def _values(info: Any, name: str) -> list[float]:
    """Return an array of a camera info, whose name is a capital letter in ROS 1."""
    found = getattr(info, name) if hasattr(info, name) else getattr(info, name.upper())
    return [float(value) for value in found]


def colour_image(message: Any) -> np.ndarray:
    """Return the pixels (h, w) or (h, w, 3) of a colour ``Image`` or ``CompressedImage``; uint8.

    Raises ``InputError`` for other encodings, such as raw Bayer patterns, and for damaged images.
    """
    if hasattr(message, "format"):
        return np.asarray(_decoded(bytes(message.data)).convert("RGB"))
    if message.encoding not in COLOURS:
        known = ", ".join(COLOURS)
        raise InputError(
            f"image encoding {message.encoding!r}",
            expected=f"one of {known}; image_proc converts Bayer patterns",
        )
    pixels = _raster(message, np.dtype(np.uint8), BYTES.get(message.encoding, 1))
    order = COLOURS[message.encoding]
    return pixels[..., 0] if len(order) == 1 else np.ascontiguousarray(pixels[..., list(order)])


def depth_image(message: Any) -> tuple[np.ndarray, float]:
    """Return the planar z (h, w) of a depth ``Image`` or ``CompressedImage``, and its metres per step.

    Raises ``InputError`` for other encodings and for damaged images.
    """
    if hasattr(message, "format"):
        return _compressed_depth(message)
    if message.encoding not in DEPTHS:
        raise InputError(f"depth encoding {message.encoding!r}", expected=f"one of {', '.join(DEPTHS)}")
    kind, unit = DEPTHS[message.encoding]
    return _raster(message, np.dtype(kind), 1)[..., 0], unit


def is_depth(message: Any) -> bool:
    """Return whether an image is a depth image, judging by its encoding."""
    if hasattr(message, "format"):
        return "compressedDepth" in message.format or message.format.partition(";")[0].strip() in DEPTHS
    return message.encoding in ("16UC1", "32FC1")


def frame_of(image: Any, camera: Intrinsics, depth: Any | None, name: str) -> Frame:
    """Build a frame from an image message, a camera of the same aspect ratio, and an optional depth message."""
    if depth is None:
        return Frame.from_numpy(colour_image(image), camera, name=name)
    metres, unit = depth_image(depth)
    return Frame.from_numpy(colour_image(image), camera, depth=metres, depth_unit=unit, name=name)


def _raster(message: Any, kind: np.dtype, channels: int) -> np.ndarray:
    """Return rows of pixels without the padding at their ends."""
    width, height, step = int(message.width), int(message.height), int(message.step)
    row, data = width * channels * kind.itemsize, np.asarray(bytearray(message.data), np.uint8)
    # An image has at most a hundred million pixels.
    if not (0 < width * height <= 100_000_000 and row <= step and len(data) >= step * (height - 1) + row):
        raise InputError(
            f"an image of {width}x{height} in rows of {step} bytes has {len(data)} bytes",
            expected=step * height,
        )
    rows = np.ascontiguousarray(np.ndarray((height, row), np.uint8, data, 0, (step, 1)))
    stored = kind.newbyteorder(">" if message.is_bigendian else "<")
    return rows.view(stored).astype(kind).reshape(height, width, channels)


def _decoded(content: bytes) -> Image.Image:
    """Decode an image within the limits of files. Raises ``InputError`` for one that is damaged, too large or too slow."""
    with open_image(PackedFile("a compressed image", lambda: content)) as image:
        image.load()
        return image.copy()


def _compressed_depth(message: Any) -> tuple[np.ndarray, float]:
    encoding, data = message.format.partition(";")[0].strip(), bytes(message.data)
    if "compressedDepth" not in message.format:  # a plain PNG, as of image_transport's "compressed"
        if "jp" in message.format.rpartition(";")[2]:
            raise InputError(f"depth of format {message.format!r} has lost its values", expected="png")
        return np.asarray(_decoded(data)), 0.001
    if len(data) < COMPRESSED_DEPTH.size:
        raise InputError("a compressed depth image is truncated")
    _, a, b = COMPRESSED_DEPTH.unpack_from(data)
    stored = np.asarray(_decoded(data[COMPRESSED_DEPTH.size :]))
    if encoding != "32FC1":
        return stored, 0.001
    with np.errstate(divide="ignore", invalid="ignore"):
        metres = np.where(stored > 0, a / (stored.astype(np.float32) - b), 0)
    return metres.astype(np.float32), 1.0
