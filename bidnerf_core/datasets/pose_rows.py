"""Cameras and their poses as numbers, converted to our conventions: ``T_world_camera`` with OpenCV axes, pixel centres at +0.5.

NeRF's and nerfstudio's JSON and ARKit's exports hold camera-to-world matrices with OpenGL axes (x right, y up, z backward).
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from bidnerf_core.camera import Intrinsics
from bidnerf_core.errors import InputError, errors_in
from bidnerf_core.geometry import RIGID_TO, SE3, rigid_pose
from bidnerf_core.io import Record


def camera_of(
    where: str | Path,
    numbers: Sequence[float],
    size: tuple[int, int],
    lens: Sequence[float] = (),
    first_centre: float = 0.5,
) -> Intrinsics:
    """Return a camera from fx, fy, cx, cy (pixels), the image ``size`` (width, height) and OpenCV's distortion, if any.

    ``first_centre`` is added to the principal point: half a pixel if the centre of the upper left pixel is (0, 0) in the
    source, 0 if it is (0.5, 0.5). Raises ``InputError``, whose message begins with ``where``, for values that
    are invalid for a camera.
    """
    fx, fy, cx, cy = numbers
    with errors_in(where):
        return Intrinsics(fx, fy, cx + first_centre, cy + first_centre, *size, tuple(lens) if any(lens) else ())


def pixel_size(where: str | Path, numbers: Sequence[float]) -> tuple[int, int]:
    """Return the width and height of an image. Raises ``InputError`` unless both are positive whole numbers below 10 million."""
    if not all(1 <= number < 10_000_000 and number == int(number) for number in numbers):
        raise InputError(
            f"its size is {' x '.join(f'{number:g}' for number in numbers)}",
            where=where,
            expected="whole numbers of pixels",
        )
    width, height = map(int, numbers)
    return width, height


def pose_and_scale(record: Record, key: str = "transform_matrix") -> tuple[SE3, float]:
    """Return ``T_world_camera`` (OpenCV axes, float64) from a matrix (3x4 or 4x4, OpenGL axes), and the scale removed from it.

    A rotation that is orthonormal up to rounding is orthonormalized. A homogeneous matrix whose last entry is
    not 1 is divided by that entry, and a uniformly scaled rotation is normalized without changing the camera
    position. The scale is 1 if neither applies. Raises ``InputError`` for any other matrix.
    """
    rows, scale = record.homogeneous(key, record.items(key))
    matrix = torch.tensor(rows, dtype=torch.float64)
    size = float(torch.linalg.det(matrix[:, :3]).abs()) ** (1 / 3)
    if size > 0 and abs(size - 1) > RIGID_TO / 2:
        matrix = torch.cat([matrix[:, :3] / size, matrix[:, 3:]], dim=1)
        scale *= size
    return pose_of_rows(record, key, matrix.tolist()), scale


def pose_of_rows(record: Record, key: str, rows: list[Any] | None) -> SE3:
    """Convert the rows (3x4 or 4x4, OpenGL axes) of a rigid transform to ``T_world_camera`` (OpenCV axes, float64).

    ``key`` is the key of ``rows`` in ``record``, for messages. Raises ``InputError`` for any other matrix.
    """
    # y up becomes y down, z backward becomes z forward.
    matrix = torch.tensor(record.matrix(key, rows), dtype=torch.float64) * torch.tensor([1.0, -1.0, -1.0, 1.0])
    return rigid_pose(matrix, record.where, f"the rotation of {key}")
