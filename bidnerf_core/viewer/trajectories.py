"""Trajectories as the page shows them: poses in chronological order, with uncertainty and outcome if the file has them."""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from bidnerf_core.datasets import read_trajectory
from bidnerf_core.errors import InputError
from bidnerf_core.geometry import SE3, LengthUnit, pose_from_matrix
from bidnerf_core.io import read_file
from bidnerf_core.results import pose_entries, standard_deviations
from bidnerf_core.viewer.packing import Packed, packed

log = logging.getLogger("bidnerf")

MOST_POSES = 20_000
"""Maximum number of poses that are shown; longer trajectories are subsampled at a regular stride."""


@dataclass(frozen=True)
class ShownTrajectory:
    """The poses of a trajectory; values missing from its file are None, or an empty string."""

    name: str
    poses: Packed  # T_world_camera without the last row, float32 (n, 12)
    frames: tuple[str, ...]
    times: tuple[float | None, ...]  # seconds
    sigmas: tuple[float | None, ...]  # standard deviation of the position
    outcomes: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class _Posed:
    T: SE3
    frame: str = ""
    time: float | None = None
    sigma: float | None = None
    outcome: str = ""
    unit: str | None = None  # None if the file does not state it


def shown_trajectory(
    path: Path, unit: LengthUnit | None = None, origin: Sequence[float] = (0.0, 0.0, 0.0)
) -> ShownTrajectory:
    """Read a trajectory: a JSON file of 'bidnerf track' or 'localize', which has uncertainties, or one of TUM, EuRoC or KITTI.

    Its poses are shown relative to ``origin``, that of the map. A remark is logged if the file states another unit than the map's ``unit``. Raises ``InputError`` for a file without poses.
    """
    found = _from_json(path) if path.suffix.lower() in (".json", ".jsonl") else _from_rows(path)
    if not found:
        raise InputError("holds no pose", where=path, expected="those of a trajectory")
    other = {each.unit for each in found} - {unit, None}
    if unit is not None and other:
        log.info(
            "%s: is in %s, but the map is in %s; its poses are shown as they are", path, other.pop(), unit
        )
    some = found[:: max(1, math.ceil(len(found) / MOST_POSES))]
    return ShownTrajectory(
        path.name,
        packed(
            SE3.stack([each.T for each in some])
            .translated(-torch.tensor(origin).double())
            .matrix()[:, :3]
            .flatten(1)
            .numpy()
        ),
        tuple(each.frame for each in some),
        tuple(each.time for each in some),
        tuple(each.sigma for each in some),
        tuple(each.outcome for each in some),
    )


def _from_rows(path: Path) -> list[_Posed]:
    found, unit = read_trajectory(path), _stated_unit(path)
    rows = zip(found.times.tolist(), found.rotations, found.translations, strict=True)
    return [_Posed(SE3(rotation, translation), time=time, unit=unit) for time, rotation, translation in rows]


def _stated_unit(path: Path) -> str | None:
    """Return the unit of lengths in the first line of a file that bidnerf wrote."""
    head = read_file(path, "a trajectory").partition(b"\n")[0]
    found = re.search(rb"^#.*lengths in (metres|units)", head)
    return None if found is None else found[1].decode()


def _from_json(path: Path) -> list[_Posed]:
    entries = pose_entries(path, read_file(path, "a trajectory"))
    return [
        _posed(entry, path) for entry in entries if isinstance(entry, dict) and entry.get("T_world_camera")
    ]


def _posed(entry: dict[str, Any], path: Path) -> _Posed:
    try:
        rows = torch.tensor(entry["T_world_camera"], dtype=torch.float64)
        covariance = entry.get("covariance")
        sigma = None
        if covariance is not None:
            sigma = standard_deviations(torch.tensor(covariance, dtype=torch.float64).reshape(6, 6))[0]
        time = entry.get("time")
        time = None if time is None else float(time)
    except (TypeError, ValueError, RuntimeError, OverflowError) as error:
        raise InputError(
            f"{entry.get('frame')!r} has no matrices of numbers", where=path, expected="poses"
        ) from error
    unit = entry.get("unit")
    finite = sigma is not None and math.isfinite(sigma)
    return _Posed(
        pose_from_matrix(rows, "T_world_camera", path), str(entry.get("frame", "")), time,
        sigma if finite else None, str(entry.get("outcome", "")), unit if isinstance(unit, str) else None,
    )  # fmt: skip
