"""Reading an image of a recording together with its depth image."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path

from jaxtyping import Bool
from torch import Tensor

from bidnerf_core.camera import Camera, Intrinsics, Raster
from bidnerf_core.depth import DepthCamera, DepthImage
from bidnerf_core.frames import Frame, fit_depth, pinhole_of
from bidnerf_core.io import read_compact_image, read_header


@dataclass(frozen=True)
class DepthFile:
    """A depth image of a recording, and how it is read."""

    path: Path
    unit: float  # metres per step
    read: Callable[[Path, float], DepthImage]  # from a file and the unit; often a ``DepthReader``
    sensor: DepthCamera | None = (
        None  # the sensor from which it is registered to its image; None if it already is
    )


@dataclass(frozen=True)
class _Side:
    pixels: int | None  # None if images keep their own size
    asked: bool


_side: ContextVar[_Side | None] = ContextVar("side", default=None)


@contextmanager
def reading_at(largest: int | None, asked: bool = False) -> Iterator[None]:
    """Let readers downscale images to ``largest`` pixels along the longer side within the context, in this
    thread.

    Images are then never held in memory at their own size. ``asked`` states that the user requested this size
    (None: that images keep theirs), which then overrides a smaller limit of the format. Readers query it with
    ``largest_side``, as ``read_rgbd`` does for them; those that ignore it still work.
    """
    token = _side.set(_Side(largest, asked))
    try:
        yield
    finally:
        _side.reset(token)


def largest_side(usual: int | None = None) -> int | None:
    """Return the current limit of the longer side in pixels, or None; ``usual`` is the format's own limit."""
    side = _side.get()
    if side is None:
        return usual
    if side.asked or usual is None:
        return side.pixels
    return usual if side.pixels is None else min(side.pixels, usual)


def read_rgbd(
    name: str,
    image: Path,
    camera_of: Callable[[int, int], Camera],
    background: Sequence[float],
    depth: DepthFile | None = None,
    hidden_of: Callable[[int, int], Bool[Tensor, "h w"] | None] = lambda width, height: None,
) -> Frame:
    """Read the image file ``image``, composited over ``background`` (rgb) if it has an alpha channel, and its
    depth.

    ``camera_of`` returns the camera for an image's width and height, or raises ``InputError`` if the size is
    not the expected one; it is called before any pixel is decoded. The images of a ``Lens`` are resampled to
    its pinhole camera. ``hidden_of`` returns the pixels to be ignored in an image of that size. Registered
    depth may be of any size: each pixel has the depth of the nearest measurement. Raises ``InputError`` for
    an unreadable file, and for registered depth of another aspect ratio.
    """
    header = read_header(image)
    camera, size = camera_of(header.width, header.height), (header.width, header.height)
    largest, reduced = largest_side(), None
    if largest is not None and isinstance(camera, Intrinsics) and max(size) > largest:
        camera = camera.scaled(largest / max(size))
        size = reduced = (camera.width, camera.height)
    rgb, alpha = read_compact_image(image, background, reduced)
    metres = None
    if depth is not None:
        measured = depth.read(depth.path, depth.unit)
        if depth.sensor is not None:
            metres = depth.sensor.registered(measured.metres, pinhole_of(camera, depth.path), depth.path)
        else:
            raster = Raster(rgb.shape[1], rgb.shape[0])
            metres = fit_depth(measured, raster, raster.size, f"{depth.path}: depth")
    return Frame.taken(name, camera, rgb, metres, alpha, hidden_of(*size))
