"""Pose files for robotics tools: KITTI's matrices and EuRoC's comma-separated values. evo reads both."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path

from bidnerf.results.pose_files import PosedImage, common_unit, time_stamps
from bidnerf_core.errors import InputWarning
from bidnerf_core.geometry import symbol
from bidnerf_core.io import write_file


def write_kitti_poses(path: Path, images: Sequence[PosedImage]) -> None:
    """KITTI poses: rows of the twelve numbers of 3x4 camera-to-world matrices, without times."""
    numbers = [image.number for image in images]
    if numbers != list(range(len(numbers))):
        skipped = next(index for index, number in enumerate(numbers) if index != number)
        warnings.warn(
            f"{path}: image {skipped} has no pose; KITTI rows do not state their image, so the following"
            " rows are shifted (.tum and .euroc.csv have times)",
            InputWarning,
            stacklevel=2,
        )
    rows = [image.pose.matrix()[:3].flatten().tolist() for image in images]
    write_file(path, "".join(" ".join(f"{number:.12g}" for number in row) + "\n" for row in rows).encode())


def write_euroc_poses(path: Path, images: Sequence[PosedImage]) -> None:
    """Camera (not body) poses in EuRoC's format: rows of nanoseconds, position, and quaternion (w, x, y, z).

    See ``time_stamps`` for the times. The header names the unit of the positions, which is ``[m]`` only for metric maps.
    """
    positions = ",".join(f"p_RS_R_{axis} [{symbol(common_unit(images))}]" for axis in "xyz")
    rows = [f"#timestamp [ns],{positions},q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []\n"]
    for time, image in time_stamps(images)[0]:
        numbers = [*image.pose.translation.tolist(), *image.pose.quaternion("wxyz").tolist()]
        rows.append(",".join([str(round(time * 10**9)), *(f"{number:.12g}" for number in numbers)]) + "\n")
    write_file(path, "".join(rows).encode())
