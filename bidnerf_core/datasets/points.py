"""Files of points that a depth sensor measured."""

from __future__ import annotations

from pathlib import Path
from zipfile import BadZipFile

import numpy as np
import torch

from bidnerf_core.errors import InputError
from bidnerf_core.files import open_binary
from bidnerf_core.observations import Observations
from bidnerf_core.se3 import SE3

EXPECTED_POINTS = "expected n rows of x, y, z in metres"


def read_depth_points(path: Path) -> Observations:
    """Read points (metres, OpenCV axes) as depth rays in the camera's frame.

    A text file (.txt, .csv, .xyz) has rows of x, y, z, separated by either commas or blanks. Further columns are ignored,
    and ``#`` begins a comment. Text and .npy files hold points in the camera's frame, measured from the camera. A .npz file
    holds ``points`` and, for a separate sensor such as a lidar, ``T_camera_sensor`` (4x4); the points are then in the
    sensor's frame. Raises ``InputError`` for anything else.
    """
    points, T_camera_sensor = _read(path)
    if points.ndim != 2 or points.shape[1] < 3 or points.dtype.kind not in "fiu":
        raise InputError(
            f"{path}: an array of shape {points.shape} and type {points.dtype}, {EXPECTED_POINTS}"
        )
    xyz = torch.from_numpy(points[:, :3].astype(np.float64))
    try:
        return Observations.from_points(xyz, T_camera_sensor)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def _read(path: Path) -> tuple[np.ndarray, SE3]:
    """Return the array in a file, and the pose of the sensor that it belongs to."""
    with open_binary(path, "a file of points") as file:
        try:
            if path.suffix not in (".npz", ".npy"):
                return _from_text(file.read().decode()), SE3.identity()
            found = np.load(file, allow_pickle=False)
            return (found, SE3.identity()) if isinstance(found, np.ndarray) else _from_archive(path, found)
        except InputError:
            raise
        except (OSError, ValueError, EOFError, BadZipFile) as error:
            raise InputError(f"{path}: not a file of points ({error}), {EXPECTED_POINTS}") from error


def _from_text(text: str) -> np.ndarray:
    """Parse rows of numbers, of which the first three count."""
    lines = [line.partition("#")[0].strip() for line in text.splitlines()]
    # A row with commas has no other separator: "1,5 2,5" has decimal commas and is refused.
    rows = [line.split("," if "," in line else None)[:3] for line in lines if line]
    return np.array([[float(word) for word in row] for row in rows], dtype=np.float64)


def _from_archive(path: Path, archive: np.lib.npyio.NpzFile) -> tuple[np.ndarray, SE3]:
    with archive:
        if "points" not in archive:
            raise InputError(f"{path}: holds {', '.join(archive) or 'nothing'}, expected an array 'points'")
        arrays = [archive[name] for name in ("points", "T_camera_sensor") if name in archive]
        if not all(isinstance(array, np.ndarray) for array in arrays):  # others come as bytes
            raise InputError(f"{path}: holds something that is not an array, {EXPECTED_POINTS} in 'points'")
        if len(arrays) == 1:
            return arrays[0], SE3.identity()
        matrix = torch.from_numpy(arrays[1].astype(np.float64))
        pose = SE3.from_matrix(matrix) if matrix.shape == (4, 4) else None
        if pose is None or not bool(pose.is_rigid()):
            raise InputError(f"{path}: T_camera_sensor is not a rigid transform, expected 4x4")
        return arrays[0], pose.normalized()
