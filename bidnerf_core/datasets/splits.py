"""The frames of a dataset in named splits, before any image is read, and the base class of datasets that read them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Generic, Protocol, TypeVar, runtime_checkable

from bidnerf_core.datasets.dataset import ReadingProgress, positions, unique_names
from bidnerf_core.datasets.sequence import FileSequence, FrameSequence, SequenceEntry
from bidnerf_core.errors import InputError
from bidnerf_core.frames import Frame, View, WhollyHidden, natural_order
from bidnerf_core.geometry import SE3, LengthUnit
from bidnerf_core.io import Background, background_colour

HOLD_OUT_EVERY = 8


@runtime_checkable
class NamedFrame(Protocol):
    """The metadata of a frame, which is named after its image file."""

    @property
    def stem(self) -> str: ...

    @property
    def parts(self) -> tuple[str, ...]:
        """The folders of the image, then its stem."""
        ...

    @property
    def time(self) -> float | None:
        """The time (seconds) at which the image was taken, if the format records it."""
        ...


F = TypeVar("F", bound=NamedFrame)


class Splits(Generic[F]):
    """The metadata of the frames in the folder ``path``, by split and name."""

    def __init__(self, path: Path, frames: dict[str, list[F]]) -> None:
        self.path = path
        self._frames = frames
        self._names = {
            split: unique_names([frame.parts for frame in group]) for split, group in frames.items()
        }

    @property
    def splits(self) -> tuple[str, ...]:
        return tuple(self._frames)

    def names(self, split: str) -> list[str]:
        """Return the names in a split, in order. Raises ``InputError`` for an unknown split."""
        self._known(split)
        return list(self._names[split])

    def select(self, split: str, names: Sequence[str] | None = None) -> list[tuple[str, F]]:
        """Return the name and metadata of the frames ``names``, in that order, or of the whole split.

        Raises ``InputError`` for an unknown split or frame.
        """
        self._known(split)
        frames, known = self._frames[split], self._names[split]
        asked = known if names is None else names
        stems = [frame.stem for frame in frames]
        places = positions(known, stems, asked, f"{self.path}: split {split!r}", self._names)
        return [(known[place], frames[place]) for place in places]

    def first(self) -> list[F]:
        """Return the first frame of each split."""
        return [group[0] for group in self._frames.values()]

    def distinct(self) -> list[tuple[str, F]]:
        """Return each frame once, with the first split that contains it; splits may share frames."""
        found = {
            id(frame): (split, frame) for split in reversed(self.splits) for frame in self._frames[split]
        }
        return list(found.values())

    def distinct_names(self) -> list[tuple[str, str]]:
        """Return each frame's first split and its name there; splits may share frames."""
        seen, found = set[int](), list[tuple[str, str]]()
        for split, group in self._frames.items():
            for name, frame in zip(self._names[split], group, strict=True):
                if id(frame) not in seen:
                    seen.add(id(frame))
                    found.append((split, name))
        return found

    def _known(self, split: str) -> None:
        if split not in self._frames:
            raise InputError(
                f"no split {split!r}", where=self.path, expected=f"one of {', '.join(self.splits)}"
            )


class SplitDataset(ABC, Generic[F]):
    """A ``Dataset`` whose frames are described by ``Splits``; subclasses read the image and pose of a frame.

    Subclasses set ``unit`` and ``up`` if their format specifies them, see ``Georeferenced``, and
    ``depth_unit`` (metres per step of depth images) if the format accepts another.
    """

    unit: LengthUnit | None = None
    up: tuple[float, float, float] | None = None
    depth_unit: float | None = None

    def __init__(self, frames: Splits[F], background: Background | None = None) -> None:
        self._frames = frames
        self._background = background_colour("black" if background is None else background)

    @property
    def path(self) -> Path:
        return self._frames.path

    @property
    def splits(self) -> tuple[str, ...]:
        return self._frames.splits

    @property
    def background(self) -> tuple[float, float, float]:
        """The requested colour, or black, since images of most formats have no alpha channel."""
        return self._background

    def frame_names(self, split: str) -> list[str]:
        return self._frames.names(split)

    def views(
        self, split: str, names: Sequence[str] | None = None, progress: ReadingProgress | None = None
    ) -> list[View]:
        frames = self._frames.select(split, names)
        views = []
        for done, (name, frame) in enumerate(frames, start=1):
            try:
                found, truth = self._posed(frame, name)
            except WhollyHidden:
                if names is not None:
                    raise
            else:
                assert truth is not None  # only frames with a pose are in splits
                views.append(View(found, truth))
            if progress is not None:
                progress(done, len(frames))
        return views

    def distinct_names(self) -> list[tuple[str, str]]:
        """Return each frame's first split and its name there; splits may share frames."""
        return self._frames.distinct_names()

    def sequence(self, others: Sequence[F] = ()) -> FrameSequence:
        """Return the frames of all splits in chronological order, or in file-name order if times are not
        recorded.

        ``others`` are frames that belong to no split because they lack something that a dataset needs.
        """
        listed: list[tuple[str | None, F]] = [*self._frames.distinct(), *((None, frame) for frame in others)]
        listed.sort(key=lambda item: natural_order("/".join(item[1].parts)))
        names = unique_names([(split or "", *frame.parts) for split, frame in listed])
        return FileSequence.ordered(
            self.path,
            [
                SequenceEntry(name, frame.time, split, partial(self._posed, frame, name))
                for name, (split, frame) in zip(names, listed, strict=True)
            ],
        )

    def _posed(self, frame: F, name: str) -> tuple[Frame, SE3 | None]:
        return self._frame(frame, name), self._pose(frame)

    @abstractmethod
    def _frame(self, frame: F, name: str) -> Frame:
        """Read the frame's image and depth. Raises ``InputError`` if a file is missing or invalid."""

    @abstractmethod
    def _pose(self, frame: F) -> SE3 | None:
        """Return ``T_world_camera``, or None if the recording does not have it."""


def hold_out(frames: list[F]) -> dict[str, list[F]]:
    """Hold out every eighth frame (the first, the ninth ...) as "test"; a single frame is in both splits."""
    others = [frame for number, frame in enumerate(frames) if number % HOLD_OUT_EVERY]
    return {"train": others or frames, "test": frames[::HOLD_OUT_EVERY]}
