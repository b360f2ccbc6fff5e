"""Depth maps of COLMAP's dense reconstruction: the text ``width&height&channels&``, then 32-bit floats, row
by row.

Depth is planar z of the undistorted image in units of the model, 0 where nothing was reconstructed.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bidnerf_core.depth import DepthImage, depth_image
from bidnerf_core.errors import InputError
from bidnerf_core.io import is_file, read_file

FOLDER = "stereo/depth_maps"
KINDS = ("geometric", "photometric")
"""The kinds of depth maps, the more reliable one first."""
LARGEST_HEAD = 64
"""Bytes of the text before the numbers."""
EXPECTED = "a COLMAP depth map"


def depth_map_of(model: Path, name: str) -> Path | None:
    """Return the depth map of an image of a model ``WORKSPACE/sparse`` or ``WORKSPACE/sparse/0``, or None."""
    for workspace in (model.parent, model.parent.parent):
        for kind in KINDS:
            file = workspace / FOLDER / f"{name}.{kind}.bin"
            if is_file(file):
                return file
    return None


def read_colmap_depth(path: Path, unit: float) -> DepthImage:
    """Read a depth map, with ``unit`` metres per unit of the model. Raises ``InputError`` for other or
    truncated files.
    """
    content = read_file(path, EXPECTED)
    *sizes, numbers = content.split(b"&", 3)
    if len(sizes) != 3 or not all(size.isdigit() and len(size) < LARGEST_HEAD for size in sizes):
        raise InputError("does not begin with width&height&channels&", where=path, expected=EXPECTED)
    width, height, channels = map(int, sizes)
    if channels != 1 or width * height < 1 or len(numbers) != 4 * width * height:
        raise InputError(
            f"has {len(numbers)} bytes after {width}&{height}&{channels}&",
            where=path,
            expected=f"{4 * width * height} of one channel",
        )
    values = np.frombuffer(numbers, "<f4").reshape(height, width)
    return depth_image(np.where(values > 0, values, 0), unit, f"{path}: depth")
