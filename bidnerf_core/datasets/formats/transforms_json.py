"""Reading frames and splits from ``transforms*.json``, without images."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from bidnerf_core.datasets.capture import SPLITS, warn_about
from bidnerf_core.datasets.file_names import posix_name
from bidnerf_core.datasets.formats.photos import timestamp
from bidnerf_core.datasets.pose_rows import pose_and_scale
from bidnerf_core.datasets.trajectories import LARGEST_SECONDS, LEAST_NANOSECONDS, NANOSECONDS
from bidnerf_core.errors import InputError, amount
from bidnerf_core.geometry import SE3
from bidnerf_core.io import IMAGE_SUFFIXES, Record, read_record

METRES_PER_DEPTH_UNIT = 0.001
SPLIT_FILES = {split: f"transforms_{split}.json" for split in SPLITS}
UNIT_KEYS = {"depth_file_path": "depth_unit_scale_factor", "depth_path": "integer_depth_scale"}
"""For each key of a depth image, the key of its metres per step: nerfstudio's, then instant-ngp's and NeRFCapture's."""


@dataclass(frozen=True, eq=False)
class FrameRecord:
    """An entry of ``frames`` with the file-level defaults applied."""

    record: Record
    file_path: PurePosixPath  # as in the file, without a leading "./"
    T_world_camera: SE3
    scale: float  # scale removed from the frame's matrix; 1 if the matrix was rigid
    depth_path: PurePosixPath | None
    depth_unit: float  # metres per step
    time: float | None  # seconds
    mask_path: PurePosixPath | None  # black is hidden

    @property
    def stem(self) -> str:
        """The name of the image without its extension, which may be missing: "r_0.5" has none."""
        return self.file_path.stem if self.file_path.suffix.lower() in IMAGE_SUFFIXES else self.file_path.name

    @property
    def parts(self) -> tuple[str, ...]:
        """The folders of the image path, followed by its stem."""
        return (*self.file_path.parts[:-1], self.stem)


def read_splits(path: Path) -> list[tuple[FrameRecord, tuple[str, ...]]]:
    """Read the frames in the folder ``path`` with their splits; frames have no split if a single file lists none.

    Raises ``InputError`` for an invalid ``transforms*.json``.
    """
    if files := {split: path / name for split, name in SPLIT_FILES.items() if (path / name).is_file()}:
        return [(frame, (split,)) for split in files for frame in read_frames(read_record(files[split]))]
    record = read_record(path / "transforms.json")
    frames, lists = read_frames(record), {split: record.items(f"{split}_filenames") or [] for split in SPLITS}
    if tests := record.items("test_frames"):  # of ScanNet++
        tested = read_frames(Record(record.where, {**record.values, "frames": tests}))
        return [*((frame, ("train",)) for frame in frames), *((frame, ("test",)) for frame in tested)]
    listed = [(split, str(name)) for split in SPLITS for name in lists[split]]
    if not listed:
        return [(frame, ()) for frame in frames]
    by_path, splits = {frame.file_path: frame for frame in frames}, dict[FrameRecord, tuple[str, ...]]()
    for split, name in listed:
        if (frame := by_path.get(posix_name(name))) is not None:
            splits[frame] = *splits.get(frame, ()), split
    if unknown := [(split, name) for split, name in listed if posix_name(name) not in by_path]:
        (split, first), count = unknown[0], len(unknown)
        found = f"{split}_filenames and the other lists have {count} that no frame has, the first of them {first!r}"
        if not splits:
            raise record.error(found, expected=f"the file_path of one of its {len(by_path)} frames")
        warn_about(record.where, found)
    return list(splits.items())


def read_frames(file: Record) -> list[FrameRecord]:
    """Read every entry of ``frames`` that has a pose; a remark counts the others.

    Raises ``InputError`` if two frames have the same image, and if no frame has a pose.
    """
    entries = file.items("frames")
    if not entries:
        raise file.error(
            "no frames" if entries is None else "frames is empty",
            expected="a list of objects with file_path and transform_matrix",
        )
    if (applied := file.items("applied_transform")) is not None:
        turn = np.array(file.matrix("applied_transform", applied))[:, :3]
        if np.linalg.det(turn) == 0:
            raise file.error("applied_transform is singular", expected="a rotation, perhaps with a scale")
    unposed = {number: entry for number, entry in enumerate(entries) if _lacks_pose(entry)}
    if 0 < len(unposed) < len(entries):
        count, first = len(unposed), next(iter(unposed.values())).get("file_path")
        found = (
            f"{count} of {amount(len(entries), 'frame')} have no pose (transform_matrix is missing, zero or not finite)"
        )
        warn_about(file.where, f"{found} and are left out, first: {first}")
    all_are = len(unposed) == len(entries)  # an error, raised when the first frame is read
    frames = [_frame(file, n, entry) for n, entry in enumerate(entries) if all_are or n not in unposed]
    seen: dict[tuple[str, ...], int] = {}
    for number, frame in enumerate(frames):
        first = seen.setdefault(frame.parts, number)
        if first != number:
            raise frame.record.error(f"has the same image as frame {first}", expected="each image once")
    if scaled := [frame for frame in frames if frame.scale != 1.0]:
        whose = "all" if len(scaled) == len(frames) else f"{len(scaled)} of"
        first = f"frame {scaled[0].file_path}: {scaled[0].scale:.6g}"
        found = f"{whose} {len(frames)} matrices have a scale ({first}), which is removed"
        warn_about(file.where, f"{found}; the positions of the cameras are those of the matrices")
    return frames


def _lacks_pose(entry: Any) -> bool:
    """Return whether a frame's matrix is missing, zero, or has non-finite entries."""
    if not isinstance(entry, dict):
        return False
    try:
        matrix = np.array(entry.get("transform_matrix"), dtype=np.float64)  # None becomes NaN
    except (TypeError, ValueError, OverflowError):  # an error when the frame is read
        return False
    return not np.isfinite(matrix).all() or (matrix.ndim == 2 and not matrix[:3, :3].any())


def _frame(file: Record, number: int, entry: object) -> FrameRecord:
    where = f"{file.where}: frame {number}"
    if not isinstance(entry, dict):
        raise InputError("is not an object", where=where, expected="one with file_path and transform_matrix")
    own = Record(where, entry)
    path, mask = own.text("file_path"), own.text("mask_path")
    if not path:
        raise own.error("no file_path", expected="the name of its image")
    record = Record(f"{where} ({path})", entry, file)
    posed, masked = pose_and_scale(Record(record.where, entry)), posix_name(mask) if mask else None
    return FrameRecord(record, posix_name(path), *posed, *_depth(record, own), _time(own), masked)


def _depth(record: Record, own: Record) -> tuple[PurePosixPath | None, float]:
    """Return the depth image of a frame, or None, and its depth unit (metres per step).

    nerfstudio and instant-ngp use different keys for both; ``enable_depth_loading`` disables instant-ngp's.
    """
    for key, unit_key in UNIT_KEYS.items():
        path = own.text(key)
        # the other program's unit if its own is missing
        units = {name: record.number(name) for name in (unit_key, *UNIT_KEYS.values())}
        stated = [name for name, unit in units.items() if unit is not None]
        unit = units[stated[0]] if stated else METRES_PER_DEPTH_UNIT
        if unit is None or unit <= 0:
            raise record.error(f"{stated[0]} is {unit:g}", expected="a positive number of metres")
        if path and (key == "depth_file_path" or record.value("enable_depth_loading") is not False):
            return posix_name(path), unit
    return None, METRES_PER_DEPTH_UNIT


def _time(own: Record) -> float | None:
    """Return ``time`` or ``timestamp`` (seconds), or the number in the name of the ``source`` file.

    Numbers too large for seconds are nanoseconds; the result is None for those between, whose unit is unknown.
    """
    for key in ("time", "timestamp"):
        if (found := own.number(key)) is not None:
            if abs(found) <= LARGEST_SECONDS:
                return found
            return found / NANOSECONDS if found >= LEAST_NANOSECONDS else None
    source = own.value("source")
    return timestamp(PurePosixPath(source).stem) if isinstance(source, str) else None
