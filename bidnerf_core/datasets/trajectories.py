"""Rows with time stamps, as in the TUM RGB-D benchmark; trajectories, and their poses interpolated in time.

A row is ``timestamp value value ...``, separated by spaces or commas; ``#`` begins a comment, empty lines are
skipped, and Windows line endings are allowed. Rows may be in any order. A truncated last row, as left by an
interrupted copy, is left out with a remark.

A trajectory is in one of three formats, distinguished by its rows. TUM: ``timestamp tx ty tz qx qy qz qw``
(seconds), or another quaternion order if a comment states it (``# timestamp tx ty tz qw qx qy qz``). EuRoC:
``timestamp,px,py,pz,qw,qx,qy,qz[,...]`` (nanoseconds). KITTI: twelve numbers, the first three rows of a 4x4
matrix, without a time, one row for each image. All are camera to world, or body to world for EuRoC.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation, Slerp
from torch import Tensor

from bidnerf_core.datasets.capture import remark
from bidnerf_core.errors import InputError, amount
from bidnerf_core.geometry import SE3, rigid_pose
from bidnerf_core.io import LARGEST_ROWS, Row, parse_rows, read_file, read_rows

NUMBERS_A_LINE = "tx ty tz qx qy qz qw"
UNIT_TO = 0.01
"""Tolerance of a quaternion's length around 1, for example because of rounding to four decimals."""
LARGEST_GAP = 0.1
"""Seconds. Within this time a hand-held camera deviates from the interpolated path by a few millimetres;
motion capture that lost its markers leaves longer gaps, in which no pose is known."""
KITTI_ROW = 12
"""Numbers in a KITTI row: a 3x4 matrix."""
NANOSECONDS = 10**9
LEAST_NANOSECONDS = 10**14
"""Integers from here on are nanoseconds: as seconds they would be three million years."""
QUATERNION_COLUMNS = re.compile(r"\bq_?(?:\w+_)?([wxyz])\b", re.IGNORECASE)


@dataclass(frozen=True)
class TimedRow:
    """A row that begins with a time stamp."""

    row: Row
    time: float  # seconds
    words: tuple[str, ...]  # what follows the time stamp
    rest: str  # the same as one string, such as a file name with spaces

    @property
    def where(self) -> str:
        """The file and the line, for messages."""
        return self.row.where


def read_timed_rows(path: Path, columns: str) -> list[TimedRow]:
    """Read the rows in chronological order; ``columns`` names the columns after the time stamp ("tx ty tz").

    Raises ``InputError`` if the file is missing, not text, too large or without rows, and for a row with too
    few entries or without a finite time.
    """
    return timed_rows(read_rows(path, "a list of time stamps", f"timestamp {columns}"), path, columns)


def timed_rows(rows: Sequence[Row], path: Path, columns: str, nanoseconds: bool = False) -> list[TimedRow]:
    """Return the rows of the file ``path`` in chronological order, as ``read_timed_rows`` does.

    Integer times are nanoseconds if ``nanoseconds`` is set, or if they are too large for seconds.
    """
    count = 1 + len(columns.split())
    if not rows:
        raise InputError("has no rows", where=path, expected=f"lines of timestamp {columns}")
    if len(rows) > 1 and len(_words(rows[-1])) < count:
        found = len(_words(rows[-1]))
        remark(rows[-1].where, f"the last row is truncated ({found} of {count} entries) and was left out")
        rows = rows[:-1]
    return sorted((_timed(row, count, nanoseconds) for row in rows), key=lambda row: row.time)


def _words(row: Row) -> list[str]:
    return row.text.replace(",", " ").split()


def _timed(row: Row, count: int, nanoseconds: bool) -> TimedRow:
    words = _words(row)
    if len(words) < count:
        raise row.error(f" has {len(words)} of {count} entries")
    try:
        time = float(words[0])
    except ValueError as error:
        raise row.error(f": {words[0]!r} is not a time stamp") from error
    if not math.isfinite(time):
        raise row.error(f": the time stamp is {words[0]}")
    if words[0].isdecimal() and (nanoseconds or time >= LEAST_NANOSECONDS):
        time = int(words[0]) / NANOSECONDS
    return TimedRow(row, time, tuple(words[1:]), row.text[len(words[0]) :].lstrip(", \t"))


def require_distinct_times(rows: list[TimedRow]) -> None:
    """Raise ``InputError`` if two of the rows, which are in chronological order, have the same time stamp."""
    for row, following in pairwise(rows):
        if row.time == following.time:
            first, second = sorted((row.row, following.row), key=lambda row: row.line)
            raise InputError(
                f"the time stamp {row.time:.6f} repeats line {first.line}",
                where=second.where,
                expected="each once",
            )


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Poses ``T_world_camera`` (OpenCV axes, metres) in chronological order (seconds), with distinct times."""

    times: Float[Tensor, "n"]
    rotations: Float[Tensor, "n 3 3"]
    translations: Float[Tensor, "n 3"]

    def __len__(self) -> int:
        return len(self.times)

    def at(self, time: float, largest_gap: float = LARGEST_GAP) -> SE3 | None:
        """Return the pose at a time: a sample, or the interpolation of its two neighbours (slerp and linear).

        Returns None before the first sample, after the last, and between two samples more than
        ``largest_gap`` seconds apart.
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


def read_trajectory(path: Path, times: Sequence[float] | None = None) -> Trajectory:
    """Read a trajectory in one of the formats above. ``times`` (seconds) are the image times, for KITTI's
    format, which has none.

    Poses that are not finite, and those whose quaternion is zero, are left out with a remark that counts
    them. Raises ``InputError``, with the file and line, if a row is truncated, a quaternion does not have
    length 1, two rows have the same time but different poses, or the number of KITTI rows differs from the
    number of images.
    """
    content = read_file(path, "a trajectory", LARGEST_ROWS)
    rows = parse_rows(content, path, "a trajectory", f"timestamp {NUMBERS_A_LINE}")
    if rows and all(len(_words(row)) == KITTI_ROW for row in rows):
        return _kitti(path, rows, times)
    nanoseconds = any("[ns]" in line for line in _comments(content))
    timed = timed_rows(rows, path, NUMBERS_A_LINE, nanoseconds)
    return _timed_trajectory(path, timed, _quaternion_order(content, rows))


def _comments(content: bytes) -> list[str]:
    lines = content.decode("utf-8-sig", "replace").splitlines()
    return [line for line in lines if line.lstrip().startswith("#")]


def _quaternion_order(content: bytes, rows: Sequence[Row]) -> str:
    """Return the quaternion order: the one stated in a comment, else that of EuRoC or TUM."""
    for line in _comments(content):
        named = "".join(QUATERNION_COLUMNS.findall(line)).lower()
        if sorted(named) == sorted("xyzw"):
            return named
    is_euroc = rows and "," in rows[0].text and _words(rows[0])[0].isdecimal()
    return "wxyz" if is_euroc and int(_words(rows[0])[0]) >= LEAST_NANOSECONDS else "xyzw"


def _timed_trajectory(path: Path, rows: Sequence[TimedRow], order: str) -> Trajectory:
    numbers = [_pose_numbers(row, order) for row in rows]
    known = [place for place, found in enumerate(numbers) if found is not None]
    if not known:
        raise InputError("has no finite pose", where=path, expected=f"lines of timestamp {NUMBERS_A_LINE}")
    if len(known) < len(rows):
        first = next(place for place, found in enumerate(numbers) if found is None)
        left = amount(len(rows) - len(known), "pose")
        remark(
            path,
            f"{left} of {len(rows)} not finite or zero, left out (first: line {rows[first].row.line})",
        )
    kept = list[int]()
    for place in known:
        if kept and rows[kept[-1]].time == rows[place].time:
            if numbers[kept[-1]] != numbers[place]:
                raise InputError(
                    f"another pose at the time {rows[place].time:.6f}",
                    where=rows[place].where,
                    expected="one pose per time",
                )
            continue
        kept.append(place)
    values = torch.tensor([numbers[place] for place in kept], dtype=torch.float64)
    rotations = torch.from_numpy(Rotation.from_quat(values[:, 3:].numpy()).as_matrix())
    times = torch.tensor([rows[place].time for place in kept], dtype=torch.float64)
    return Trajectory(times, rotations, values[:, :3])


def check_unit(length: float, where: str, names: str) -> None:
    """Raise ``InputError``, which begins with ``where``, unless the length of a quaternion is 1."""
    if abs(length - 1) > UNIT_TO:
        raise InputError(f"the quaternion has length {length:.3g}", where=where, expected=f"1 ({names})")


def _pose_numbers(row: TimedRow, order: str) -> list[float] | None:
    """Return the translation and the quaternion (x, y, z, w) of a row, or None if it holds no pose."""
    numbers = row.row.plain_numbers(row.words[:7])
    quaternion = dict(zip(order, numbers[3:], strict=True))
    length = math.hypot(*numbers[3:])
    if length == 0 or not all(map(math.isfinite, numbers)):
        return None
    check_unit(length, row.where, " ".join(f"q{letter}" for letter in order))
    return [*numbers[:3], *(quaternion[letter] for letter in "xyzw")]


def _kitti(path: Path, rows: Sequence[Row], times: Sequence[float] | None) -> Trajectory:
    """Return the poses in rows of 3x4 matrices, one for each of ``times``."""
    kind = f"has rows of {KITTI_ROW} numbers, KITTI's 3x4 poses, which have no times"
    if times is None or len(times) != len(rows):
        images = "images with known times" if times is None else amount(len(times), "image")
        raise InputError(
            f"{kind}; there are {len(rows)} for {images}", where=path, expected="one for each image"
        )
    remark(
        path, f"rows of {KITTI_ROW} numbers are read as KITTI's 3x4 camera-to-world poses, one for each image"
    )
    poses = [_kitti_pose(row) for row in rows]
    return Trajectory(
        torch.tensor(times, dtype=torch.float64),
        torch.stack([pose.rotation for pose in poses]),
        torch.stack([pose.translation for pose in poses]),
    )


def _kitti_pose(row: Row) -> SE3:
    return rigid_pose(torch.tensor(row.numbers(_words(row)), dtype=torch.float64).reshape(3, 4), row.where)


def read_matrices(path: Path) -> list[SE3]:
    """Read KITTI's rows of twelve numbers as poses ``T_world_camera``. Raises ``InputError``, with file and
    line, for others.
    """
    rows = read_rows(path, "a file of KITTI poses", f"{KITTI_ROW} numbers, a 3x4 matrix")
    if len(rows) > 1 and len(_words(rows[-1])) < KITTI_ROW:
        remark(rows[-1].where, "the last row is truncated and was left out")
        rows = rows[:-1]
    if not rows:
        raise InputError("has no rows", where=path, expected=f"{KITTI_ROW} numbers in each")
    for row in rows:
        if len(_words(row)) != KITTI_ROW:
            raise row.error(f" has {len(_words(row))} entries")
    return [_kitti_pose(row) for row in rows]
