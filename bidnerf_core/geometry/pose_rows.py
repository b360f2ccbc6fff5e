"""Camera poses as rows of numbers, converted to our conventions: ``T_world_camera`` with OpenCV axes.

NeRF's and nerfstudio's JSON and ARKit's exports hold camera-to-world matrices with OpenGL axes (x right, y up, z backward).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.errors import InputError
from bidnerf_core.geometry.se3 import SE3
from bidnerf_core.io import Record, read_rows

LARGEST_POSE = 4096
"""Largest size of a file with one pose, in bytes."""
RIGID_TO = 5e-3
"""Largest entry of R^T R - 1 that is attributed to rounding (matrices printed with three decimals reach 2e-3)."""


def pose_and_scale(record: Record, key: str = "transform_matrix") -> tuple[SE3, float]:
    """Return ``T_world_camera`` (OpenCV axes, float64) from a matrix (3x4 or 4x4, OpenGL axes), and the scale removed from it.

    A rotation that is orthonormal up to rounding is orthonormalized. A homogeneous matrix whose last entry is
    not 1 is divided by it, and a rotation of uniform scale is normalized; the position of the camera is that
    of the matrix. The scale is 1 if neither applies. Raises ``InputError`` for any other matrix.
    """
    matrix, scale = _homogeneous(record, key, record.items(key))
    size = float(torch.linalg.det(matrix[:, :3]).abs()) ** (1 / 3)
    if size > 0 and abs(size - 1) > RIGID_TO / 2:
        matrix = torch.cat([matrix[:, :3] / size, matrix[:, 3:]], dim=1)
        scale *= size
    return _rigid(record, key, _opencv(matrix)), scale


def pose_of_rows(record: Record, key: str, rows: list[Any] | None) -> SE3:
    """Convert the rows (3x4 or 4x4, OpenGL axes) of a rigid transform to ``T_world_camera`` (OpenCV axes,
    float64).

    ``key`` is the key of ``rows`` in ``record``, for messages. Raises ``InputError`` for any other matrix.
    """
    return _rigid(record, key, _opencv(_matrix(record, key, rows)))


def _opencv(matrix: Float[Tensor, "3 4"]) -> Float[Tensor, "3 4"]:
    """Convert a pose from OpenGL to OpenCV axes: y up becomes y down, z backward becomes z forward."""
    return matrix * matrix.new_tensor([1.0, -1.0, -1.0, 1.0])


def rigid_of_rows(record: Record, key: str, rows: list[Any]) -> SE3:
    """Return the rigid transform (float64) that ``rows`` (3x4 or 4x4) represent up to rounding, whatever its axes.

    ``key`` is their key in ``record``, for messages. Raises ``InputError`` for any other matrix.
    """
    return _rigid(record, key, _matrix(record, key, rows))


def _rigid(record: Record, key: str, matrix: Float[Tensor, "3 4"]) -> SE3:
    try:
        return rigid_pose(matrix)
    except InputError as error:
        raise record.error(f"the rotation of {key} is {error}", expected="a rigid transform") from error


def rigid_pose(matrix: Float[Tensor, "3 4"]) -> SE3:
    """Return the rigid transform that ``matrix`` represents up to rounding.

    Raises ``InputError`` for any other matrix; the message states only what is wrong with its rotation part.
    """
    given = SE3(matrix[:3, :3], matrix[:3, 3])
    if not given.is_rigid(RIGID_TO):
        off = (given.rotation.mT @ given.rotation - torch.eye(3, dtype=torch.float64)).abs().max().item()
        raise InputError(f"off orthonormal by {off:.2g}" if not off <= RIGID_TO else "a mirror image")
    return given.normalized()


def _matrix(record: Record, key: str, rows: list[Any] | None) -> Float[Tensor, "3 4"]:
    """Return the first three rows of a 3x4 or 4x4 matrix of finite numbers; a fourth row must be 0 0 0 1."""
    matrix, scale = _homogeneous(record, key, rows)
    if scale != 1.0:
        raise record.error(f"the last row of {key} is [0, 0, 0, {scale:g}]", expected="[0, 0, 0, 1]")
    return matrix


def _homogeneous(record: Record, key: str, rows: list[Any] | None) -> tuple[Float[Tensor, "3 4"], float]:
    """Return the first three rows, divided by the last entry of a fourth row 0 0 0 w, and w (1 up to rounding)."""
    if rows is None:
        raise record.error(f"no {key}", expected="a 4x4 camera-to-world matrix")
    if len(rows) not in (3, 4) or not all(isinstance(row, list) and len(row) == 4 for row in rows):
        raise record.error(f"{key} is not 3x4 or 4x4", expected="a 4x4 matrix")
    numbers = [[record.checked_number(x, f"an entry of {key}") for x in row] for row in rows]
    last = numbers[3] if len(numbers) == 4 else [0.0, 0.0, 0.0, 1.0]
    if not last[3] > 0 or max(map(abs, last[:3])) > 1e-6 * last[3]:
        raise record.error(f"the last row of {key} is {last}", expected="[0, 0, 0, 1]")
    scale = last[3] if abs(last[3] - 1) > 1e-6 else 1.0
    return torch.tensor(numbers[:3], dtype=torch.float64) / scale, scale


def read_pose_matrix(path: Path) -> SE3:
    """Read ``T_world_camera`` (metres, OpenCV axes, float64) from a text file with one 4x4 matrix.

    Raises ``InputError``, which names the offending line.
    """
    expected = "4 rows of 4 numbers, the last of them 0 0 0 1"
    rows = [row.numbers(count=4) for row in read_rows(path, "a file of a pose", expected, LARGEST_POSE)]
    if len(rows) != 4:
        raise InputError(f"has {len(rows)} rows", where=path, expected=expected)
    if max(abs(x - y) for x, y in zip(rows[3], (0, 0, 0, 1), strict=True)) > 1e-6:
        raise InputError(f"the last row is {rows[3]}", where=path, expected=expected)
    try:
        return rigid_pose(torch.tensor(rows[:3], dtype=torch.float64))
    except InputError as error:
        raise InputError(f"the rotation is {error}", where=path, expected="a rigid transform") from error
