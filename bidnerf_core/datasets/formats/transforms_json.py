"""The frames and splits described by ``transforms*.json``; no image is read here."""

from __future__ import annotations

import math
from collections.abc import Iterable
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
DEPTH_KEYS = ("depth_file_path", "depth_path")
"""The keys of a depth image: nerfstudio's, and that of instant-ngp and NeRFCapture."""
UNIT_KEYS = ("depth_unit_scale_factor", "integer_depth_scale")
"""The keys for the metres per step of its values, in the same order."""


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
        said = self.record.value("unit")
        return said if said in get_args(LengthUnit) else None

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
        for frame in _listed(record, by_path, f"{split}_filenames", listed or []):
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
    frames = [_frame(file, number, entry) for number, entry in _posed(file, entries)]
    seen: dict[tuple[str, ...], int] = {}
    for number, frame in enumerate(frames):
        first = seen.setdefault(frame.parts, number)
        if first != number:
            raise frame.record.error(f"has the same image as frame {first}", expected="each image once")
    _remark_scales(file, frames)
    for row in file.items("applied_transform") or []:  # which is not undone
        for number in row if isinstance(row, list) else [row]:
            file.checked_number(number, "an entry of applied_transform")
    if file.value("enable_depth_loading") is False and any(
        "depth_path" in frame.record.values for frame in frames
    ):
        remark(file.where, "enable_depth_loading is false, so the images of depth_path are not read")
    return frames


def _posed(file: Record, entries: list[Any]) -> list[tuple[int, Any]]:
    """Return the numbered entries without those lacking a pose, unless all of them do."""
    kept = [(number, entry) for number, entry in enumerate(entries) if not _lacks_pose(entry)]
    if kept and len(kept) < len(entries):
        first = next(entry for entry in entries if _lacks_pose(entry))
        remark(
            file.where,
            f"{len(entries) - len(kept)} of {amount(len(entries), 'frame')} have no pose (transform_matrix"
            f" is missing, zero or not finite) and are left out, first: {first.get('file_path')}",
        )
    return kept or list(enumerate(entries))


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


def _remark_scales(file: Record, frames: list[FrameRecord]) -> None:
    scaled = [frame for frame in frames if frame.scale != 1.0]
    if scaled:
        whose = "all" if len(scaled) == len(frames) else f"{len(scaled)} of"
        first = scaled[0]
        remark(
            file.where,
            f"{whose} {len(frames)} matrices have a scale (frame {first.file_path}: {first.scale:.6g}), which is removed; the"
            " positions of the cameras are those of the matrices",
        )


def _listed(
    file: Record, by_path: dict[PurePosixPath, FrameRecord], key: str, entries: Iterable[object]
) -> list[FrameRecord]:
    """Return the frames that a list names. A remark counts the names without a frame."""
    given = list(entries)
    found = [by_path.get(posix_name(entry)) if isinstance(entry, str) else None for entry in given]
    strange = [entry for entry, frame in zip(given, found, strict=True) if frame is None]
    if strange and len(strange) < len(given):
        remark(
            file.where,
            f"{key} lists {strange[0]!r}{f' and {len(strange) - 1} more' if len(strange) > 1 else ''}, which no frame has; the"
            f" other {len(given) - len(strange)} are used",
        )
    return [frame for frame in found if frame is not None]


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
    for key, unit_key in zip(DEPTH_KEYS, UNIT_KEYS, strict=True):
        path = own.text(key)
        if path and not (key == "depth_path" and record.value("enable_depth_loading") is False):
            return posix_name(path), _unit(record, (unit_key, *UNIT_KEYS))
    return None, _unit(record, UNIT_KEYS)


def _unit(record: Record, keys: Iterable[str]) -> float:
    for key in keys:
        unit = record.number(key)
        if unit is not None and unit <= 0:
            raise record.error(f"{key} is {unit:g}", expected="a positive number of metres")
        if unit is not None:
            return unit
    return METRES_PER_DEPTH_UNIT


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
