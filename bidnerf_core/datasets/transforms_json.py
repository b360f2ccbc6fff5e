"""The frames and splits described by ``transforms*.json``; no image is read here."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from bidnerf_core.camera.files import CameraRecord, camera_record
from bidnerf_core.datasets.sequence import timestamp
from bidnerf_core.datasets.splits import hold_out
from bidnerf_core.errors import InputError
from bidnerf_core.geometry.pose_rows import pose
from bidnerf_core.geometry.se3 import SE3
from bidnerf_core.io.images import IMAGE_SUFFIXES
from bidnerf_core.io.json import Record, read_record

SPLITS = ("train", "val", "test")
METRES_PER_DEPTH_UNIT = 0.001


@dataclass(frozen=True, eq=False)
class FrameRecord:
    """One entry of ``frames`` with the defaults of its file applied."""

    record: Record
    file_path: PurePosixPath  # as in the file, without a leading "./"
    camera: CameraRecord
    T_world_camera: SE3
    depth_path: str | None
    depth_unit: float  # metres
    time: float | None  # seconds

    @property
    def stem(self) -> str:
        known = self.file_path.suffix.lower() in IMAGE_SUFFIXES
        return self.file_path.stem if known else self.file_path.name  # "r_0.5" may have no extension

    @property
    def parts(self) -> tuple[str, ...]:
        """The folders of the image, then its stem."""
        return (*self.file_path.parts[:-1], self.stem)


def read_splits(path: Path) -> dict[str, list[FrameRecord]]:
    """Read the frames of each split of the folder ``path``. Raises ``InputError`` for a description that is not usable."""
    files = {split: path / file_of(split) for split in SPLITS if (path / file_of(split)).is_file()}
    if files:
        return {split: read_frames(read_record(file)) for split, file in files.items()}
    record = read_record(path / "transforms.json")
    return split_frames(record, read_frames(record))


def read_frames(file: Record) -> list[FrameRecord]:
    """Read every entry of ``frames``. Raises ``InputError`` where two have the same image."""
    entries = file.items("frames")
    if not entries:
        found = "no frames" if entries is None else "frames is empty"
        raise file.error(f"{found}, expected a list of objects with file_path and transform_matrix")
    frames = [_frame(file, number, entry) for number, entry in enumerate(entries)]
    seen: dict[tuple[str, ...], int] = {}
    for number, frame in enumerate(frames):
        first = seen.setdefault(frame.parts, number)
        if first != number:
            raise frame.record.error(f"the image of frame {first} again, expected each image once")
    return frames


def split_frames(file: Record, frames: list[FrameRecord]) -> dict[str, list[FrameRecord]]:
    """Split one ``transforms.json`` by its lists of file names, or hold out every eighth frame where it has none."""
    lists = {split: file.items(f"{split}_filenames") for split in SPLITS}
    if not any(lists.values()):
        return hold_out(frames)
    by_path = {frame.file_path: frame for frame in frames}
    splits = {}
    for split, listed in lists.items():
        if listed:
            splits[split] = [_listed(file, by_path, f"{split}_filenames", entry) for entry in listed]
    return splits


def _listed(file: Record, by_path: dict[PurePosixPath, FrameRecord], key: str, entry: object) -> FrameRecord:
    found = by_path.get(PurePosixPath(entry)) if isinstance(entry, str) else None
    if found is None:
        raise file.error(f"{key} lists {entry!r}, expected the file_path of one of its {len(by_path)} frames")
    return found


def _frame(file: Record, number: int, entry: object) -> FrameRecord:
    where = f"{file.where}: frame {number}"
    if not isinstance(entry, dict):
        raise InputError(f"{where}: is not an object, expected one with file_path and transform_matrix")
    own = Record(where, entry)
    path = own.text("file_path")
    if not path:
        raise own.error("no file_path, expected the name of its image")
    record = Record(f"{where} ({path})", entry, file)
    unit = record.number("depth_unit_scale_factor")
    if unit is not None and unit <= 0:
        raise record.error(f"depth_unit_scale_factor is {unit:g}, expected a positive number of metres")
    return FrameRecord(
        record,
        PurePosixPath(path),
        camera_record(record),
        pose(Record(record.where, entry)),
        own.text("depth_file_path"),
        METRES_PER_DEPTH_UNIT if unit is None else unit,
        _time(own),
    )


def _time(own: Record) -> float | None:
    """Return ``time`` or ``timestamp`` (seconds), or the number that is the name of the file in ``source``."""
    for key in ("time", "timestamp"):
        if (found := own.number(key)) is not None:
            return found
    source = own.value("source")
    return timestamp(PurePosixPath(source).stem) if isinstance(source, str) else None


def file_of(split: str) -> str:
    """Return the name of the file that describes a split."""
    return f"transforms_{split}.json"
