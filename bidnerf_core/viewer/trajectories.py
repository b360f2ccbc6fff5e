"""Trajectories as the page shows them: poses in chronological order, with uncertainty and outcome if the file has them."""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeAlias

import torch

from bidnerf_core.datasets import read_trajectory
from bidnerf_core.errors import InputError
from bidnerf_core.geometry import SE3, LengthUnit, pose_from_matrix
from bidnerf_core.io import read_file
from bidnerf_core.results import pose_entries, standard_deviations
from bidnerf_core.viewer.pictures import Json, packed

log = logging.getLogger("bidnerf")


def shown_trajectory(
    path: Path, unit: LengthUnit | None = None, origin: Sequence[float] = (0.0, 0.0, 0.0)
) -> Json:
    """Read a trajectory: a JSON file of 'bidnerf track' or 'localize', which has uncertainties, or one of TUM, EuRoC or KITTI.

    Its poses are shown relative to ``origin``, that of the map. A remark is logged if the file states another unit than
    the map's ``unit``. Raises ``InputError`` for a file without poses.

    In the result, ``poses`` are T_world_camera without the last row, float32 (n, 12), ``times`` are in seconds, and
    ``sigmas`` are standard deviations of the position. What the file does not state is None or an empty string.
    """
    content = read_file(path, "a trajectory")
    if path.suffix.lower() in (".json", ".jsonl"):
        found = [_posed(entry, path) for entry in pose_entries(path, content) if isinstance(entry, dict)]
        found = [each for each in found if each[0] is not None]
    else:
        rows = read_trajectory(path)
        stated = re.search(rb"^#.*lengths in (metres|units)", content.partition(b"\n")[0])  # by bidnerf
        of = None if stated is None else stated[1].decode()
        poses = zip(rows.times.tolist(), rows.rotations, rows.translations, strict=True)
        found = [
            (SE3(rotation, translation), "", time, None, "", of) for time, rotation, translation in poses
        ]
    if not found:
        raise InputError("holds no pose", where=path, expected="those of a trajectory")
    some = found[:: max(1, math.ceil(len(found) / 20_000))]  # longer ones are subsampled at a regular stride
    T, frames, times, sigmas, outcomes, _ = zip(*some, strict=True)
    other = {each[-1] for each in found} - {unit, None}
    if unit is not None and other:
        log.info(
            "%s: is in %s, but the map is in %s; its poses are shown as they are", path, other.pop(), unit
        )
    shown = SE3.stack(list(T)).translated(-torch.tensor(origin).double()).matrix()[:, :3]
    return {
        "name": path.name, "poses": packed(shown.flatten(1).numpy()), "frames": frames, "times": times, "sigmas": sigmas,
        "outcomes": outcomes,
    }  # fmt: skip


_Posed: TypeAlias = tuple[SE3 | None, str, float | None, float | None, str, str | None]
"""A pose, the frame's name, its time, the standard deviation of the position, the outcome, and the unit of lengths."""


def _posed(entry: dict[str, Any], path: Path) -> _Posed:
    try:
        rows, covariance = entry.get("T_world_camera"), entry.get("covariance")
        T = (
            pose_from_matrix(torch.tensor(rows, dtype=torch.float64), "T_world_camera", path)
            if rows
            else None
        )
        sigma = math.nan
        if covariance is not None:
            sigma = standard_deviations(torch.tensor(covariance, dtype=torch.float64).reshape(6, 6))[0]
        time = None if entry.get("time") is None else float(entry["time"])
    except InputError:
        raise
    except (TypeError, ValueError, RuntimeError, OverflowError) as error:
        raise InputError(
            f"{entry.get('frame')!r} has no matrices of numbers", where=path, expected="poses"
        ) from error
    unit = entry.get("unit")
    return (
        T, str(entry.get("frame", "")), time, sigma if math.isfinite(sigma) else None, str(entry.get("outcome", "")),
        unit if isinstance(unit, str) else None,
    )  # fmt: skip
