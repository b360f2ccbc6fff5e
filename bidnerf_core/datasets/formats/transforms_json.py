"""The frames and splits described by ``transforms*.json``; no image is read here."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, get_args

from bidnerf_core.camera import CameraRecord, camera_record
from bidnerf_core.datasets.capture import SPLITS, remark
from bidnerf_core.datasets.file_names import posix_name
from bidnerf_core.datasets.formats.photos import timestamp
from bidnerf_core.datasets.pose_rows import pose_and_scale
from bidnerf_core.datasets.trajectories import LEAST_NANOSECONDS, NANOSECONDS
from bidnerf_core.errors import InputError, amount
from bidnerf_core.geometry import SE3, LengthUnit
from bidnerf_core.io import IMAGE_SUFFIXES, Record, read_record

METRES_PER_DEPTH_UNIT = 0.001
UNIT_KEYS = {"depth_file_path": "depth_unit_scale_factor", "depth_path": "integer_depth_scale"}
"""The keys of a depth image, nerfstudio's and that of instant-ngp and NeRFCapture, with those of the metres per step of its
values."""


@dataclass(frozen=True, eq=False)
class FrameRecord:
    """One entry of ``frames`` with the defaults of its file applied."""

    record: Record
    file_path: PurePosixPath  # as in the file, without a leading "./"
    camera: CameraRecord
    T_world_camera: SE3
    scale: float  # removed from its matrix; 1 if that was rigid
    depth_path: PurePosixPath | None
    depth_unit: float  # metres
    time: float | None  # seconds
    mask_path: PurePosixPath | None  # black is hidden

    @property
    def unit(self) -> LengthUnit | None:
        """The unit of its position if the file states ``"unit": "metres"`` or ``"units"``, as bidnerf's files do."""
        stated = self.record.value("unit")
        return stated if stated in get_args(LengthUnit) else None

    @property
    def stem(self) -> str:
        known = self.file_path.suffix.lower() in IMAGE_SUFFIXES
        return self.file_path.stem if known else self.file_path.name  # "r_0.5" may have no extension

    @property
    def parts(self) -> tuple[str, ...]:
        """The folders of the image, then its stem."""
        return (*self.file_path.parts[:-1], self.stem)


def read_splits(path: Path) -> list[tuple[FrameRecord, tuple[str, ...]]]:
    """Read the frames of the folder ``path`` with their splits, none of them if a single file lists no splits.

    Raises ``InputError`` for an invalid ``transforms*.json``.
    """
    files = {split: path / file_of(split) for split in SPLITS if (path / file_of(split)).is_file()}
    if files:
        return [
            (frame, (split,)) for split, file in files.items() for frame in read_frames(read_record(file))
        ]
    record = read_record(path / "transforms.json")
    frames, lists = read_frames(record), {split: record.items(f"{split}_filenames") for split in SPLITS}
    if not any(lists.values()):
        return [(frame, ()) for frame in frames]
    by_path = {frame.file_path: frame for frame in frames}
    splits: dict[FrameRecord, tuple[str, ...]] = {}  # in the order of the lists
    for split, listed in lists.items():
        names = [posix_name(name) if isinstance(name, str) else None for name in listed or []]
        own = [by_path[name] for name in names if name in by_path]
        strange = [name for name, path in zip(listed or [], names, strict=True) if path not in by_path]
        if strange and own:
            more = f" and {len(strange) - 1} more" if len(strange) > 1 else ""
            text = f"{split}_filenames lists {strange[0]!r}{more}, which no frame has; the other {len(own)} are used"
            remark(record.where, text)
        for frame in own:
            splits[frame] = *splits.get(frame, ()), split
    if not splits:
        (key, listed), *_ = ((f"{split}_filenames", listed) for split, listed in lists.items() if listed)
        raise record.error(
            f"{key} lists {listed[0]!r}", expected=f"the file_path of one of its {len(by_path)} frames"
        )
    return list(splits.items())


def read_frames(file: Record) -> list[FrameRecord]:
    """Read every entry of ``frames`` that has a pose; a remark counts the others.

    Raises ``InputError`` if two have the same image, and if none has a pose.
    """
    entries = file.items("frames")
    if not entries:
        found = "no frames" if entries is None else "frames is empty"
        raise file.error(found, expected="a list of objects with file_path and transform_matrix")
    unposed = [entry for entry in entries if _lacks_pose(entry)]
    if 0 < len(unposed) < len(entries):
        remark(
            file.where,
            f"{len(unposed)} of {amount(len(entries), 'frame')} have no pose (transform_matrix"
            f" is missing, zero or not finite) and are left out, first: {unposed[0].get('file_path')}",
        )
    is_used = [len(unposed) == len(entries) or not _lacks_pose(entry) for entry in entries]
    frames = [_frame(file, number, entry) for number, entry in enumerate(entries) if is_used[number]]
    seen: dict[tuple[str, ...], int] = {}
    for number, frame in enumerate(frames):
        first = seen.setdefault(frame.parts, number)
        if first != number:
            raise frame.record.error(f"has the same image as frame {first}", expected="each image once")
    if scaled := [frame for frame in frames if frame.scale != 1.0]:
        whose = "all" if len(scaled) == len(frames) else f"{len(scaled)} of"
        remark(
            file.where,
            f"{whose} {len(frames)} matrices have a scale (frame {scaled[0].file_path}: {scaled[0].scale:.6g}), which is"
            " removed; the positions of the cameras are those of the matrices",
        )
    for row in file.items("applied_transform") or []:  # which is not undone
        for number in row if isinstance(row, list) else [row]:
            file.checked_number(number, "an entry of applied_transform")
    if file.value("enable_depth_loading") is False and any("depth_path" in f.record.values for f in frames):
        remark(file.where, "enable_depth_loading is false, so the images of depth_path are not read")
    return frames


def _lacks_pose(entry: Any) -> bool:
    """Return whether a frame has no matrix, a zero matrix, or one with numbers that are not finite."""
    if not isinstance(entry, dict):
        return False
    rows = entry.get("transform_matrix")
    if rows is None:
        return True
    if not isinstance(rows, list) or not all(isinstance(row, list) for row in rows):
        return False
    numbers = [value for row in rows for value in row]
    if any(isinstance(value, float) and not math.isfinite(value) for value in numbers):
        return True
    return bool(numbers) and all(value in (0, None) for row in rows[:3] for value in row[:3])


def _frame(file: Record, number: int, entry: object) -> FrameRecord:
    where = f"{file.where}: frame {number}"
    if not isinstance(entry, dict):
        raise InputError("is not an object", where=where, expected="one with file_path and transform_matrix")
    own = Record(where, entry)
    path = own.text("file_path")
    if not path:
        raise own.error("no file_path", expected="the name of its image")
    record = Record(f"{where} ({path})", entry, file)
    T_world_camera, scale = pose_and_scale(Record(record.where, entry))
    depth, unit = _depth(record, own)
    return FrameRecord(
        record,
        posix_name(path),
        camera_record(record),
        T_world_camera,
        scale,
        depth,
        unit,
        _time(own),
        posix_name(mask) if (mask := own.text("mask_path")) else None,
    )


def _depth(record: Record, own: Record) -> tuple[PurePosixPath | None, float]:
    """Return the depth image of a frame, or None, and the metres per step of its values.

    nerfstudio and instant-ngp use different keys for both; ``enable_depth_loading`` disables instant-ngp's.
    """
    paths = {key: own.text(key) for key in UNIT_KEYS}
    if record.value("enable_depth_loading") is False:
        paths["depth_path"] = None
    used = next((key for key, path in paths.items() if path), "depth_file_path")
    for key in (UNIT_KEYS[used], *UNIT_KEYS.values()):
        unit = record.number(key)
        if unit is not None and unit <= 0:
            raise record.error(f"{key} is {unit:g}", expected="a positive number of metres")
        if unit is not None:
            break
    path = paths[used]
    return posix_name(path) if path else None, METRES_PER_DEPTH_UNIT if unit is None else unit


def _time(own: Record) -> float | None:
    """Return ``time`` or ``timestamp`` (seconds), or the number in the name of the ``source`` file."""
    for key in ("time", "timestamp"):
        if (found := own.number(key)) is not None:
            return found / NANOSECONDS if found >= LEAST_NANOSECONDS else found
    source = own.value("source")
    return timestamp(PurePosixPath(source).stem) if isinstance(source, str) else None


def file_of(split: str) -> str:
    """Return the name of the file that describes a split."""
    return f"transforms_{split}.json"
