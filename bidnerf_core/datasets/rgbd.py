"""Reading an image of a recording with the depth image that belongs to it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path

from jaxtyping import Bool
from torch import Tensor

from bidnerf_core.camera.intrinsics import Intrinsics
from bidnerf_core.camera.lenses import Camera
from bidnerf_core.camera.source import Raster
from bidnerf_core.depth.images import DepthImage
from bidnerf_core.depth.registration import DepthCamera
from bidnerf_core.frames.frame import Frame
from bidnerf_core.frames.photos import fit_depth, pinhole_of
from bidnerf_core.frames.resampling import Images
from bidnerf_core.io.images import read_compact_image, read_header


@dataclass(frozen=True)
class DepthFile:
    """A depth image of a recording, and how it is read."""

    path: Path
    unit: float  # metres per step
    read: Callable[[Path, float], DepthImage]  # from a file and the unit; often a ``DepthReader``
    sensor: DepthCamera | None = (
        None  # the sensor from which it is registered to its image; None: it already is
    )


_largest: ContextVar[int | None] = ContextVar("largest", default=None)


@contextmanager
def reading_at(largest: int) -> Iterator[None]:
    """Let ``read_rgbd`` reduce images to ``largest`` pixels along the longer side within the context, in this thread.

    Images are then never in memory at their own size. Readers that do not use ``read_rgbd`` do without.
    """
    token = _largest.set(largest)
    try:
        yield
    finally:
        _largest.reset(token)


def read_rgbd(
    name: str,
    image: Path,
    camera_of: Callable[[int, int], Camera],
    background: Sequence[float],
    depth: DepthFile | None = None,
    hidden_of: Callable[[int, int], Bool[Tensor, "h w"] | None] = lambda width, height: None,
) -> Frame:
    """Read the image file ``image``, laid over ``background`` (rgb) where it has an alpha channel, and its depth.

    ``camera_of`` returns the camera of an image of a width and height, or raises ``InputError`` where that is not the size
    expected; it is called before any pixel is decoded. The images of a ``Lens`` are resampled to its pinhole camera.
    ``hidden_of`` returns the pixels that are not to be used, of an image of that size. Registered depth may be of any size: each pixel has that of the nearest
    measurement. Raises ``InputError`` for a file that is not readable, and for registered depth of another aspect ratio.
    """
    header = read_header(image)
    camera, size = camera_of(header.width, header.height), (header.width, header.height)
    largest, reduced = _largest.get(), None
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
    hidden = hidden_of(*size)
    return Frame.taken(name, camera, Images(rgb, metres, alpha, hidden))
