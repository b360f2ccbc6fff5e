"""Sequences: frames in chronological order, read one at a time.

``open_sequence`` (see ``bidnerf_core.datasets``) returns one for every format that ``open_dataset`` reads, for folders of
images, and for video files.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Protocol, TypeAlias, overload, runtime_checkable

from bidnerf_core.datasets.dataset import Dataset, unique_names
from bidnerf_core.errors import InputError
from bidnerf_core.frames import Frame, natural_order
from bidnerf_core.geometry import SE3

ReadFrame: TypeAlias = Callable[[], tuple[Frame, SE3 | None]]
"""Reads the files of a frame; the pose is ``T_world_camera`` if known."""

TIMESTAMP = re.compile(r"\d+\.\d+")


@dataclass(frozen=True, eq=False)
class TimedFrame:
    """A frame of a sequence, its time, and its true pose if known."""

    time: float | None  # seconds, from an origin that depends on the recording
    frame: Frame  # without colours (``has_colour``) if only depth was recorded at this time
    truth: SE3 | None = None  # T_world_camera, OpenCV axes, if the recording has it
    split: str | None = None  # the split of the dataset that holds the frame


@runtime_checkable
class FrameSequence(Protocol):
    """Frames in chronological order. Each is read when the iteration reaches it, which may raise
    ``InputError``.

    Either all frames have a time or none has. Iterating again starts over.
    """

    @property
    def path(self) -> Path: ...

    def __len__(self) -> int: ...

    def __iter__(self) -> Iterator[TimedFrame]: ...


@dataclass(frozen=True, eq=False)
class SequenceEntry:
    """A frame that has not been read yet."""

    name: str
    time: float | None  # seconds
    split: str | None
    read: ReadFrame


class FileSequence:
    """A sequence whose frames are separate files, so it can be indexed, sliced and reversed."""

    # Not a subclass of collections.abc.Sequence: run-time type checkers inspect an item of those, which would
    # read a file.

    def __init__(self, path: Path, entries: Sequence[SequenceEntry]) -> None:
        self._path, self._entries = path, entries

    @staticmethod
    def ordered(path: Path, entries: Sequence[SequenceEntry]) -> FileSequence:
        """Return the frames in order of time; if any lacks a time, in the given order and all without times."""
        if any(entry.time is None for entry in entries):
            return FileSequence(path, [replace(entry, time=None) for entry in entries])
        return FileSequence(path, sorted(entries, key=lambda entry: entry.time or 0.0))

    @property
    def path(self) -> Path:
        return self._path

    @property
    def entries(self) -> Sequence[SequenceEntry]:
        """The frames, without reading any."""
        return self._entries

    @property
    def names(self) -> list[str]:
        """The names of the frames, without reading any."""
        return [entry.name for entry in self._entries]

    @property
    def times(self) -> list[float | None]:
        """The times of the frames (seconds), without reading any."""
        return [entry.time for entry in self._entries]

    def of_split(self, split: str) -> FileSequence:
        """Return the frames of one split of a dataset. Raises ``InputError`` if there are none."""
        chosen = [entry for entry in self._entries if entry.split == split]
        if not chosen:
            known = ", ".join(sorted({entry.split for entry in self._entries if entry.split is not None}))
            why = "" if known else ", since only frames of a dataset with poses have a split"
            raise InputError(
                f"no frame belongs to a split {split!r}{why}",
                where=self._path,
                expected=f"one of {known}" if known else None,
            )
        return FileSequence(self._path, chosen)

    def __len__(self) -> int:
        return len(self._entries)

    def __iter__(self) -> Iterator[TimedFrame]:
        return (self[place] for place in range(len(self)))

    @overload
    def __getitem__(self, place: int) -> TimedFrame: ...

    @overload
    def __getitem__(self, place: slice) -> FileSequence: ...

    def __getitem__(self, place: int | slice) -> TimedFrame | FileSequence:
        """Read one frame, or return a slice of the sequence, such as every second frame (``[::2]``)."""
        if isinstance(place, slice):
            return FileSequence(self._path, self._entries[place])
        entry = self._entries[place]
        frame, truth = entry.read()
        return TimedFrame(entry.time, frame, truth, entry.split)


def timestamp(stem: str) -> float | None:
    """Return the time (seconds) in a file name such as ``1305031102.175304.png``; None for names without a fraction."""
    return float(stem) if TIMESTAMP.fullmatch(stem) else None


def sequence_of(dataset: Dataset) -> FileSequence:
    """Return the frames of all splits of a dataset in natural name order, without times."""
    listed = [(split, name) for split in dataset.splits for name in dataset.frame_names(split)]
    listed.sort(key=lambda frame: natural_order(frame[1]))
    return FileSequence.ordered(
        dataset.path,
        [
            SequenceEntry(name, None, split, partial(_posed, dataset, split, own))
            for name, (split, own) in zip(unique_names(listed), listed, strict=True)
        ],
    )


def _posed(dataset: Dataset, split: str, name: str) -> tuple[Frame, SE3]:
    (view,) = dataset.views(split, [name])
    return view.frame, view.T_ref_camera
