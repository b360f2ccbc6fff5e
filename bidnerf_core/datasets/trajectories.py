"""Readers of timestamped rows (as in the TUM RGB-D benchmark), tables, and trajectories with poses interpolated in time.

A row is ``timestamp value value ...``, separated by spaces or commas; ``#`` begins a comment, empty lines are
skipped, and Windows line endings are allowed. Rows may be in any order. A truncated last row, as left by an
interrupted copy, is left out with a remark.

A trajectory is in one of three formats, distinguished by its rows. TUM: ``timestamp tx ty tz qx qy qz qw``
(seconds), or another quaternion order if a comment states it (``# timestamp tx ty tz qw qx qy qz``). EuRoC:
``timestamp,px,py,pz,qw,qx,qy,qz[,...]`` (nanoseconds). KITTI: twelve numbers, the first three rows of a 4x4
matrix, without a time, one row for each image. All are camera to world, or body to world for EuRoC.
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation, Slerp
from torch import Tensor

from bidnerf_core.datasets.capture import warn_about
from bidnerf_core.errors import InputError, amount
from bidnerf_core.geometry import SE3, rigid_pose
from bidnerf_core.io import LARGEST_ROWS, Row, is_file, parse_rows, read_file, read_lines, read_rows

POSE = "tx ty tz qx qy qz qw"
LARGEST_GAP = 0.1
"""Largest gap (seconds) between samples to interpolate. In this time, a hand-held camera deviates from the interpolated path
by a few millimetres; motion capture that lost its markers leaves longer gaps, in which no pose is known."""
KITTI_ROW = 12
"""Numbers in a KITTI row: a 3x4 matrix."""
NANOSECONDS = 10**9
LEAST_NANOSECONDS = 10**17
"""Timestamps from here on are nanoseconds, from 1973 on if they count from 1970; those of today in microseconds are a hundredth."""
LARGEST_SECONDS = 10**11
"""Timestamps between this one and the least in nanoseconds are in no unit that is read: as seconds, they would be millennia."""


@dataclass(frozen=True)
class TimedRow:
    """A row that begins with a timestamp."""

    row: Row
    time: float  # seconds
    words: list[str]  # the entries after the timestamp

    @property
    def rest(self) -> str:
        """The text after the timestamp as one string, such as a file name with spaces."""
        return self.row.text[len(_words(self.row)[0]) :].lstrip(", \t")


def column_names(line: str) -> list[str]:
    """Return the column names in the header of a table, in lower case."""
    return [name.strip().lstrip("#").strip().lower() for name in line.split(",")]


def read_table(path: Path, expected: str, columns: str, needed: set[str]) -> list[tuple[Row, dict[str, str]]]:
    """Read rows of comma-separated values below a header, each with a dictionary of its cells by column name.

    ``expected`` briefly describes the file, ``columns`` its header. Raises ``InputError`` if ``needed`` columns are
    missing, and for rows that are too short; a truncated last row is left out with a remark.
    """
    first, *lines = read_lines(path, expected, columns)
    names = column_names(first.text)
    if not needed <= set(names):
        raise first.error(f" has the columns {first.text[:60]!r}")
    rows = list[tuple[Row, list[str]]]()
    for line in (line for line in lines if line.text):
        try:
            rows.append((line, [cell.strip() for cell in next(csv.reader([line.text]))]))
        except csv.Error as error:  # such as a carriage return inside a field
            raise line.error(f" is no row of comma-separated values ({error})") from error
    return [(row, dict(zip(names, cells, strict=False))) for row, cells in _complete(path, rows, len(names), columns)]


def _complete(
    path: Path, rows: Sequence[tuple[Row, list[str]]], count: int, columns: str
) -> Sequence[tuple[Row, list[str]]]:
    """Return rows of at least ``count`` words, with their words; a truncated last row is left out with a remark."""
    if not rows:
        raise InputError("has no rows", where=path, expected=f"lines of {columns}")
    last, words = rows[-1]
    if len(rows) > 1 and len(words) < count:
        warn_about(last.where, f"the last row is truncated ({len(words)} of {count} entries) and was left out")
        rows = rows[:-1]
    for row, words in rows:
        if len(words) < count:
            raise row.error(f" has {len(words)} of {count} entries")
    return rows


def _words(row: Row) -> list[str]:
    return row.text.replace(",", " ").split()


def _timed_rows(rows: Sequence[Row], path: Path, columns: str, nanoseconds: bool = False) -> list[TimedRow]:
    """Return rows that begin with a time stamp, followed by ``columns``, in chronological order.

    Integer times are nanoseconds if ``nanoseconds`` is set, and all times if they are too large for seconds. Raises ``InputError``
    for a row with too few entries, without a finite time or with one in another unit, and if there are no rows.
    """
    timed = list[TimedRow]()
    columns = f"timestamp {columns}"
    for row, (stamp, *words) in _complete(path, [(row, _words(row)) for row in rows], len(columns.split()), columns):
        try:
            time = float(stamp)
        except ValueError as error:
            raise row.error(f": {stamp[:60]!r} is not a time stamp") from error
        if not math.isfinite(time):
            raise row.error(f": the time stamp is {stamp[:60]}")
        if time >= LEAST_NANOSECONDS or (nanoseconds and stamp.isdecimal()):
            time = (int(stamp) if stamp.isdecimal() else time) / NANOSECONDS
        elif abs(time) > LARGEST_SECONDS:
            raise row.error(f": {stamp[:60]} is no time in seconds; is it in milliseconds or microseconds?")
        timed.append(TimedRow(row, time, words))
    return sorted(timed, key=lambda row: row.time)


def read_timed_files(path: Path, nanoseconds: bool = False) -> list[TimedRow]:
    """Read a list of files with timestamps, in chronological order; integer times are ``nanoseconds`` if that is set.

    Raises ``InputError`` if the list is missing, not text, too large or empty, and for a row without a file name, without a
    finite time, or with the time of another row.
    """
    rows = _timed_rows(read_rows(path, "a list of time stamps", "timestamp filename"), path, "filename", nanoseconds)
    for row, following in pairwise(rows):
        if row.time == following.time:
            first, second = sorted((row.row, following.row), key=lambda row: row.line)
            raise InputError(
                f"the time stamp {row.time:.6f} repeats line {first.line}",
                where=second.where,
                expected="each once",
            )
    return rows


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Poses ``T_world_camera`` (OpenCV axes, metres) in chronological order, with distinct times (seconds)."""

    times: Float[Tensor, "n"]
    rotations: Float[Tensor, "n 3 3"]
    translations: Float[Tensor, "n 3"]

    def __len__(self) -> int:
        return len(self.times)

    def at(self, time: float, largest_gap: float = LARGEST_GAP) -> SE3 | None:
        """Return the pose at a time: a sample, or the interpolation (slerp and linear) of the two neighbouring samples.

        Returns None before the first sample, after the last, and between two samples more than
        ``largest_gap`` seconds apart.
        """
        after = int(np.searchsorted(self.times.numpy(), time))
        if after < len(self) and float(self.times[after]) == time:
            return SE3(self.rotations[after], self.translations[after])
        if after in (0, len(self)):
            return None
        start, end = (float(self.times[index]) for index in (after - 1, after))
        if end - start > largest_gap:
            return None
        share = (time - start) / (end - start)
        turns = Slerp([0.0, 1.0], Rotation.from_matrix(self.rotations[after - 1 : after + 1].numpy()))
        return SE3(
            torch.from_numpy(turns(share).as_matrix()),
            torch.lerp(self.translations[after - 1], self.translations[after], share),
        )


def read_trajectory(path: Path, times: Sequence[float] | None = None) -> Trajectory:
    """Read a trajectory in one of the formats that this module supports.

    ``times`` (seconds) holds the image times, needed only for KITTI's format, which stores none. Poses that are not finite, and
    those whose quaternion is zero, are left out with a remark that counts them. Raises ``InputError``, with the
    file and line, if a row is truncated, a quaternion does not have length 1, two rows have the same time but
    different poses, or the number of KITTI rows differs from the number of images.
    """
    content = read_file(path, "a trajectory", LARGEST_ROWS)
    rows = parse_rows(content, path, "a trajectory", f"timestamp {POSE}")
    if rows and all(len(_words(row)) == KITTI_ROW for row in rows):
        kind = f"rows of {KITTI_ROW} numbers, KITTI's 3x4 camera-to-world poses"
        if times is None or len(times) != len(rows):
            images = "images with known times" if times is None else amount(len(times), "image")
            raise InputError(
                f"has {kind}, which have no times; there are {len(rows)} for {images}",
                where=path,
                expected="one for each image",
            )
        warn_about(path, f"is read as {kind}, one for each image")
        poses = SE3.stack(read_matrices(path))
        return Trajectory(torch.tensor(times, dtype=torch.float64), poses.rotation, poses.translation)
    comments = [line for line in content.decode("utf-8-sig", "replace").splitlines() if line.lstrip().startswith("#")]
    nanoseconds = any("[ns]" in line for line in comments)
    timed = _timed_rows(rows, path, POSE, nanoseconds)
    # The quaternion order is the one that a comment states, else that of EuRoC or TUM.
    stated = ["".join(re.findall(r"\bq_?(?:\w+_)?([wxyz])\b", line, re.IGNORECASE)).lower() for line in comments]
    stamp, known = _words(rows[0])[0], list[tuple[TimedRow, list[float]]]()
    is_euroc = "," in rows[0].text and stamp.isdecimal() and (nanoseconds or int(stamp) >= LEAST_NANOSECONDS)
    order = next((named for named in stated if sorted(named) == sorted("xyzw")), "wxyz" if is_euroc else "xyzw")
    for row in timed:
        numbers = pose_numbers(row.row.where, row.row.plain_numbers(row.words[:7]), order)
        if numbers is not None:
            known.append((row, numbers))
    if not known:
        raise InputError("has no finite pose", where=path, expected=f"lines of timestamp {POSE}")
    if len(known) < len(timed):
        warn_about(path, f"{amount(len(timed) - len(known), 'pose')} of {len(timed)} not finite or zero, left out")
    for (one, pose), (other, others) in pairwise(known):
        if one.time == other.time and pose != others:
            raise InputError(
                f"another pose at the time {other.time:.6f}", where=other.row.where, expected="one pose per time"
            )
    stamps, first = np.unique([row.time for row, _ in known], return_index=True)
    values = torch.tensor([numbers for _, numbers in known], dtype=torch.float64)[torch.from_numpy(first)]
    rotations = torch.from_numpy(Rotation.from_quat(values[:, 3:].numpy()).as_matrix())
    return Trajectory(torch.from_numpy(stamps), rotations, values[:, :3])


def pose_numbers(where: str, numbers: Sequence[float], order: str = "xyzw") -> list[float] | None:
    """Return a position and its quaternion reordered to (x, y, z, w), or None if the numbers represent no pose.

    Raises ``InputError``, whose message begins with ``where``, unless the quaternion has length 1 up to rounding.
    """
    quaternion, length = dict(zip(order, numbers[3:], strict=True)), math.hypot(*numbers[3:])
    if length == 0 or not all(map(math.isfinite, numbers)):
        return None
    if abs(length - 1) > 0.01:  # more than rounding explains, for example to four decimals
        raise InputError(
            f"the quaternion has length {length:.3g}",
            where=where,
            expected=f"1 ({' '.join(f'q{letter}' for letter in order)})",
        )
    return [*numbers[:3], *(quaternion[letter] for letter in "xyzw")]


def pose_of_numbers(where: str, numbers: Sequence[float], opengl: bool) -> SE3 | None:
    """Return ``T_world_camera`` (OpenCV axes) from a position and quaternion (x y z w), or None if they represent no pose.

    The numbers use OpenGL's camera axes if ``opengl`` is set, otherwise OpenCV's. Raises ``InputError`` for a quaternion
    whose length is not 1.
    """
    found = pose_numbers(where, numbers)
    if found is None:
        return None
    rotation = torch.from_numpy(Rotation.from_quat(found[3:]).as_matrix())
    if opengl:
        rotation = rotation * rotation.new_tensor([1.0, -1.0, -1.0])
    return SE3(rotation, torch.tensor(found[:3], dtype=torch.float64))


def numbers_in(where: object, given: object, count: int) -> list[float]:
    """Return the numbers in a text, separated by spaces or commas, in a list, or in the ``data`` of a matrix in YAML.

    Raises ``InputError`` unless there are ``count`` of them, all finite.
    """
    listed = given.get("data") if isinstance(given, Mapping) else given
    words = listed.replace(",", " ").split() if isinstance(listed, str) else listed if isinstance(listed, list) else []
    try:
        numbers = [float(word) for word in words]
    except (TypeError, ValueError) as error:
        raise InputError(error, where=where, expected=f"{count} numbers") from error
    if len(numbers) != count:
        raise InputError(f"has {len(numbers)} numbers", where=where, expected=f"{count}")
    if not all(map(math.isfinite, numbers)):
        raise InputError(f"{' '.join(map(str, words))[:60]!r} is not finite", where=where, expected=f"{count} numbers")
    return numbers


def pose_of_matrix(where: object, numbers: Sequence[float], what: str = "the rotation") -> SE3:
    """Return the pose in the first three rows of a four-column matrix stored row by row.

    Raises ``InputError``, whose message begins with ``where``, if the rotation, called ``what`` there, is invalid.
    """
    return rigid_pose(torch.tensor(numbers, dtype=torch.float64).reshape(-1, 4)[:3], where, what)


def read_matrices(path: Path) -> list[SE3]:
    """Read KITTI's rows of twelve numbers as poses ``T_world_camera``.

    Raises ``InputError``, with file and line, for rows of any other kind.
    """
    columns = f"{KITTI_ROW} numbers, a 3x4 matrix"
    rows = [(row, _words(row)) for row in read_rows(path, "a file of KITTI poses", columns)]
    return [
        pose_of_matrix(row.where, row.numbers(words, KITTI_ROW))
        for row, words in _complete(path, rows, KITTI_ROW, columns)
    ]


def read_pose_matrix(path: Path) -> SE3 | None:
    """Read ``T_world_camera`` (metres, OpenCV axes, float64) from a text file with one 4x4 matrix.

    Returns None if the file does not exist, or if it contains non-finite numbers, which mean that tracking failed.

    Raises ``InputError`` for any other content.
    """
    if not is_file(path):
        return None
    expected = "4 rows of 4 numbers, the last of them 0 0 0 1"
    lines = read_rows(path, "a file of a pose", expected, most=4096)
    if not np.isfinite([number for row in lines for number in row.plain_numbers(row.words)]).all():
        return None
    rows = [row.numbers(count=4) for row in lines]
    if len(rows) != 4:
        raise InputError(f"has {len(rows)} rows", where=path, expected=expected)
    if not np.allclose(rows[3], (0, 0, 0, 1), rtol=0, atol=1e-6):
        raise InputError(f"the last row is {rows[3]}", where=path, expected=expected)
    return pose_of_matrix(path, [number for row in rows for number in row])
