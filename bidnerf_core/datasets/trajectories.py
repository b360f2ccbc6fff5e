"""Rows with time stamps, as in the TUM RGB-D benchmark; trajectories, and their poses at the times in between.

A row is ``timestamp value value ...``, separated by blanks or commas; ``#`` begins a comment, empty lines are skipped, and
Windows line endings are allowed. Rows may be in any order.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation, Slerp
from torch import Tensor

from bidnerf_core.errors import InputError
from bidnerf_core.geometry.se3 import SE3
from bidnerf_core.io.rows import Row, read_rows

NUMBERS_A_LINE = "tx ty tz qx qy qz qw"
UNIT_TO = 0.01
"""How far the length of a quaternion may be from 1, for example because of rounding to four decimals."""
LARGEST_GAP = 0.1
"""Seconds. Within this time a hand-held camera deviates from the interpolated path by a few millimetres; motion capture that
lost its markers leaves longer gaps, in which no pose is known."""


@dataclass(frozen=True)
class TimedRow:
    """A row that begins with a time stamp."""

    row: Row
    time: float  # seconds
    words: tuple[str, ...]  # what follows the time stamp

    @property
    def where(self) -> str:
        """The file and the line, for messages."""
        return self.row.where


def read_timed_rows(path: Path, columns: str) -> list[TimedRow]:
    """Read the rows in chronological order; ``columns`` names the columns after the time stamp ("tx ty tz").

    Raises ``InputError`` where the file is missing, not text, too large or without rows, and for a row with fewer
    entries or without a finite time.
    """
    rows = [
        _timed(row, 1 + len(columns.split()))
        for row in read_rows(path, "a list of time stamps", f"timestamp {columns}")
    ]
    if not rows:
        raise InputError(f"{path}: has no rows, expected lines of timestamp {columns}")
    return sorted(rows, key=lambda row: row.time)


def _timed(row: Row, count: int) -> TimedRow:
    words = row.text.replace(",", " ").split()
    if len(words) < count:
        raise row.error(f" has {len(words)} of {count} entries")
    try:
        time = float(words[0])
    except ValueError as error:
        raise row.error(f": {words[0]!r} is no time stamp") from error
    if not math.isfinite(time):
        raise row.error(f": the time stamp is {words[0]}")
    return TimedRow(row, time, tuple(words[1:]))


def require_distinct_times(rows: list[TimedRow]) -> None:
    """Raise ``InputError`` where two of the rows, which are in chronological order, have the same time stamp."""
    for row, following in pairwise(rows):
        if row.time == following.time:
            first, second = sorted((row.row, following.row), key=lambda row: row.line)
            raise InputError(
                f"{second.where}: the time stamp {row.time:.6f} of line {first.line} again, expected each once"
            )


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Poses ``T_world_camera`` (OpenCV axes, metres) in chronological order (seconds); no time occurs twice."""

    times: Float[Tensor, "n"]
    rotations: Float[Tensor, "n 3 3"]
    translations: Float[Tensor, "n 3"]

    def __len__(self) -> int:
        return len(self.times)

    def at(self, time: float, largest_gap: float = LARGEST_GAP) -> SE3 | None:
        """Return the pose at a time: a sample, or the interpolation of its two neighbours (slerp and linear).

        None before the first sample, after the last, and between two that are more than ``largest_gap`` seconds apart.
        """
        after = int(np.searchsorted(self.times.numpy(), time))
        if after < len(self) and float(self.times[after]) == time:
            return SE3(self.rotations[after], self.translations[after])
        if after in (0, len(self)):
            return None
        start, end = (float(self.times[place]) for place in (after - 1, after))
        if end - start > largest_gap:
            return None
        share = (time - start) / (end - start)
        turns = Slerp([0.0, 1.0], Rotation.from_matrix(self.rotations[after - 1 : after + 1].numpy()))
        rotation = torch.from_numpy(turns(share).as_matrix())
        return SE3(rotation, torch.lerp(self.translations[after - 1], self.translations[after], share))


def read_trajectory(path: Path) -> Trajectory:
    """Read a file of rows ``timestamp tx ty tz qx qy qz qw``, such as TUM's ``groundtruth.txt`` or what ``bidnerf`` writes.

    Raises ``InputError``, with the file and line, where a row is cut off, a number is not finite, a quaternion is not of
    length 1, or two rows have the same time and different poses.
    """
    rows = read_timed_rows(path, NUMBERS_A_LINE)
    numbers = [_pose_numbers(row) for row in rows]
    kept = list[int]()
    for place, row in enumerate(rows):
        if kept and rows[kept[-1]].time == row.time:
            if numbers[kept[-1]] != numbers[place]:
                raise InputError(
                    f"{row.where}: another pose at the time {row.time:.6f}, expected one pose a time"
                )
            continue
        kept.append(place)
    values = torch.tensor([numbers[place] for place in kept], dtype=torch.float64)
    rotations = torch.from_numpy(Rotation.from_quat(values[:, 3:].numpy()).as_matrix())
    times = torch.tensor([rows[place].time for place in kept], dtype=torch.float64)
    return Trajectory(times, rotations, values[:, :3])


def _pose_numbers(row: TimedRow) -> list[float]:
    """Return the translation and the quaternion (x, y, z, w) of a row."""
    numbers = row.row.numbers(row.words[:7])
    length = math.hypot(*numbers[3:])
    if abs(length - 1) > UNIT_TO:
        raise InputError(f"{row.where}: the quaternion has length {length:.3g}, expected 1 (qx qy qz qw)")
    return numbers
