"""Text files of one pose: a 4x4 matrix, camera to world, OpenCV axes."""

from __future__ import annotations

import math
from pathlib import Path

import torch

from bidnerf_core.errors import InputError
from bidnerf_core.geometry.pose_rows import rigid_pose
from bidnerf_core.geometry.se3 import SE3
from bidnerf_core.io.files import open_binary

EXPECTED = "expected 4 rows of 4 numbers, the last of them 0 0 0 1"
LARGEST_POSE = 4096
"""Bytes."""


def read_pose_matrix(path: Path) -> SE3:
    """Return ``T_world_camera`` (metres, float64). Raises ``InputError``, which names the line that is not usable."""
    with open_binary(path, "a file of a pose") as file:
        text = file.read(LARGEST_POSE).decode("utf-8-sig", "replace")
    rows = [
        _row(f"{path}: line {number}", line)
        for number, line in enumerate(text.split("\n"), start=1)
        if line.strip()
    ]
    if len(rows) != 4:
        raise InputError(f"{path}: has {len(rows)} rows, {EXPECTED}")
    if max(abs(x - y) for x, y in zip(rows[3], (0, 0, 0, 1), strict=True)) > 1e-6:
        raise InputError(f"{path}: the last row is {rows[3]}, {EXPECTED}")
    try:
        return rigid_pose(torch.tensor(rows[:3], dtype=torch.float64))
    except InputError as error:
        raise InputError(f"{path}: the rotation is {error}, expected a rigid transform") from error


def _row(where: str, line: str) -> list[float]:
    try:
        numbers = [float(word) for word in line.split()]
    except ValueError as error:
        raise InputError(f"{where}: {error}, {EXPECTED}") from error
    if len(numbers) != 4:
        raise InputError(f"{where} has {len(numbers)} entries, {EXPECTED}")
    if not all(map(math.isfinite, numbers)):
        raise InputError(f"{where}: {line.strip()[:60]!r} is not finite, {EXPECTED}")
    return numbers
