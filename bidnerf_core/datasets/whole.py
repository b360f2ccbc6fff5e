"""All views of a dataset, regardless of their split: ``--split all``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

from bidnerf_core.datasets.dataset import Dataset, ReadingProgress, positions, unique_names
from bidnerf_core.datasets.masked import MaskedDataset, wholly_hidden
from bidnerf_core.datasets.splits import SplitDataset
from bidnerf_core.errors import InputError
from bidnerf_core.frames import View, WhollyHidden
from bidnerf_core.geometry import LengthUnit

ALL = "all"
"""The name that selects all splits together, unless a dataset has a split of that name."""


@dataclass(frozen=True, eq=False)
class WholeDataset:
    """A ``Dataset`` with one split, ALL, that contains each view of another dataset once.

    Views with the same name in two splits are prefixed with the name of their split.
    """

    parts: Dataset

    @property
    def path(self) -> Path:
        return self.parts.path

    @property
    def splits(self) -> tuple[str, ...]:
        return (ALL,)

    @property
    def unit(self) -> LengthUnit | None:
        """The unit of the poses, if the format specifies it."""
        return getattr(self.parts, "unit", None)

    @property
    def depth_unit(self) -> float | None:
        """Metres per step of the depth images, if the format accepts another unit."""
        return getattr(self.parts, "depth_unit", None)

    @property
    def up(self) -> tuple[float, float, float] | None:
        """The upward direction in the world, if the capture measured gravity."""
        return getattr(self.parts, "up", None)

    @property
    def background(self) -> tuple[float, float, float]:
        return self.parts.background

    @cached_property
    def _listed(self) -> list[tuple[str, str]]:
        """Each view's split and its name there."""
        unmasked = self.parts.unmasked if isinstance(self.parts, MaskedDataset) else self.parts
        if isinstance(unmasked, SplitDataset):  # it knows what its splits share
            return unmasked.distinct_names()
        return [(split, name) for split in self.parts.splits for name in self.parts.frame_names(split)]

    @cached_property
    def _names(self) -> list[str]:
        return unique_names(self._listed)

    def frame_names(self, split: str) -> list[str]:
        if split != ALL:
            raise InputError(f"no split {split!r}", where=self.path, expected=ALL)
        return list(self._names)

    def origin(self, name: str) -> tuple[str, str]:
        """Return the split of a view, and its name there."""
        return self._listed[self._names.index(name)]

    def wholly_hidden(self, split: str) -> list[str]:
        """Return the frames whose masks leave nothing visible."""
        hidden = {(of, name) for of in self.parts.splits for name in wholly_hidden(self.parts, of)}
        return [
            own for own, place in zip(self.frame_names(split), self._listed, strict=True) if place in hidden
        ]

    def views(
        self, split: str, names: Sequence[str] | None = None, progress: ReadingProgress | None = None
    ) -> list[View]:
        known = self.frame_names(split)
        stems = [name for _, name in self._listed]
        asked = positions(known, stems, known if names is None else names, f"{self.path}: split {split!r}")
        found = list[View]()
        for done, place in enumerate(asked, start=1):
            of, name = self._listed[place]
            try:
                views = self.parts.views(of, [name])
            except WhollyHidden:
                if names is not None:
                    raise
                continue
            found += [replace(view, frame=view.frame.replace(name=known[place])) for view in views]
            if progress is not None:
                progress(done, len(asked))
        return found


def with_all(dataset: Dataset, split: str) -> Dataset:
    """Return a dataset that has ``split``, which may be ALL; any other split leaves the dataset unchanged."""
    return WholeDataset(dataset) if split == ALL and ALL not in dataset.splits else dataset


def all_views(dataset: Dataset) -> list[View]:
    """Read the views of all splits, each once. Raises ``InputError`` as ``Dataset.views`` does."""
    return with_all(dataset, ALL).views(ALL)
