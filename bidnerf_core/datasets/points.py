"""Files of points measured by a depth sensor."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from bidnerf_core.errors import InputError
from bidnerf_core.fields import Observations
from bidnerf_core.geometry import SE3, pose_from_matrix
from bidnerf_core.io import read_archive, read_array, read_rows

EXPECTED_POINTS = "n rows of x, y, z in metres"


def read_depth_points(path: Path) -> Observations:
    """Read points (metres, OpenCV axes) as depth rays in the camera's frame.

    A text file (.txt, .csv, .xyz) has rows of x, y, z, separated by commas or spaces. Further columns are
    ignored, and ``#`` begins a comment. Text and .npy files hold points in the camera's frame, measured from
    the camera. A .npz file holds ``points`` and, for a separate sensor such as a lidar, ``T_camera_sensor``
    (4x4); the points are then in the sensor's frame. Raises ``InputError`` for anything else.
    """
    points: np.ndarray = np.zeros(0)
    T_camera_sensor = SE3.identity()
    if path.suffix == ".npz":
        arrays = read_archive(path, ("points", "T_camera_sensor"), "a .npz file of points")
        if "points" not in arrays:
            raise InputError("no array 'points'", where=path, expected=f"one with {EXPECTED_POINTS}")
        points = arrays["points"]
        if (given := arrays.get("T_camera_sensor")) is not None:
            matrix = (
                torch.from_numpy(given.astype(np.float64)) if given.dtype.kind in "fiu" else torch.empty(0)
            )
            T_camera_sensor = pose_from_matrix(matrix, "T_camera_sensor", path)
    elif path.suffix == ".npy":
        points = read_array(path, "a .npy file of points")
    else:
        rows = read_rows(path, "a file of points", EXPECTED_POINTS)
        # A row with commas has no other separator: "1,5 2,5" has decimal commas and is rejected.
        words = [(row, row.text.split("," if "," in row.text else None)[:3]) for row in rows]
        lengths = {len(found) for _, found in words}
        if len(lengths) > 1:
            found = f"has rows of {min(lengths)} and of {max(lengths)} numbers"
            raise InputError(found, where=path, expected=EXPECTED_POINTS)
        points = np.array([row.numbers(found) for row, found in words], dtype=np.float64)
    if points.ndim != 2 or points.shape[1] < 3 or points.dtype.kind not in "fiu":
        raise InputError(
            f"has an array of shape {points.shape} and type {points.dtype}",
            where=path,
            expected=EXPECTED_POINTS,
        )
    xyz = torch.from_numpy(points[:, :3].astype(np.float64))
    try:
        return Observations.from_points(xyz, T_camera_sensor)
    except InputError as error:
        raise InputError(error, where=path) from error
