"""Datasets and sequences whose images have masks in a separate folder."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import torch

from bidnerf_core.camera import CentralLens, Raster
from bidnerf_core.datasets.dataset import Dataset, ReadingProgress
from bidnerf_core.datasets.sequence import FileSequence, FrameSequence, ReadFrame, SequenceEntry, TimedFrame
from bidnerf_core.errors import InputError, InputWarning
from bidnerf_core.frames import Frame, MaskFolder, View, WhollyHidden
from bidnerf_core.geometry import SE3, LengthUnit


class MaskedDataset:
    """A dataset whose frames also hide what the masks in a folder hide; see ``Dataset``.

    When a whole split is read, frames that are entirely hidden are left out. Raises ``InputError`` if no
    frame has a mask.
    """

    def __init__(self, dataset: Dataset, masks: MaskFolder) -> None:
        self.unmasked, self._masks = dataset, masks
        masks.require_any([name for split in dataset.splits for name in dataset.frame_names(split)])

    @property
    def path(self) -> Path:
        return self.unmasked.path

    @property
    def splits(self) -> tuple[str, ...]:
        return self.unmasked.splits

    @property
    def unit(self) -> LengthUnit | None:
        """The unit of the poses, if the format specifies it."""
        return getattr(self.unmasked, "unit", None)

    @property
    def depth_unit(self) -> float | None:
        """Metres per step of the depth images, if the format accepts another unit."""
        return getattr(self.unmasked, "depth_unit", None)

    @property
    def up(self) -> tuple[float, float, float] | None:
        """The upward direction in the world, if the capture measured gravity."""
        return getattr(self.unmasked, "up", None)

    @property
    def background(self) -> tuple[float, float, float]:
        return self.unmasked.background

    def frame_names(self, split: str) -> list[str]:
        return self.unmasked.frame_names(split)

    def wholly_hidden(self, split: str) -> list[str]:
        """Return the frames of a split whose masks leave nothing visible; only masks are read."""
        own = set(wholly_hidden(self.unmasked, split))
        return [name for name in self.frame_names(split) if name in own or self._masks.hides_all(name)]

    def views(
        self, split: str, names: Sequence[str] | None = None, progress: ReadingProgress | None = None
    ) -> list[View]:
        found = []
        for view in self.unmasked.views(split, names, progress):
            try:
                found.append(replace(view, frame=masked(view.frame, self._masks)))
            except WhollyHidden:
                if names is not None:
                    raise
        return found


def wholly_hidden(dataset: Dataset, split: str) -> list[str]:
    """Return the frames of a split of which a mask leaves nothing visible, if the dataset has masks; only masks are read."""
    told = getattr(dataset, "wholly_hidden", None)
    return [] if told is None else list(told(split))


def mask_folder(masks: str | Path | MaskFolder) -> MaskFolder:
    """Return the mask folder; black is hidden unless it specifies otherwise."""
    return masks if isinstance(masks, MaskFolder) else MaskFolder(masks)


def masked(frame: Frame, masks: MaskFolder) -> Frame:
    """Return the frame with its mask, found by name, applied. Raises ``InputError`` as ``MaskFolder.hidden`` does."""
    lens = frame.lens if isinstance(frame.lens, CentralLens) else None
    camera = frame.intrinsics if lens is None else lens  # the mask refers to the image before undistortion
    size, orientation = (camera.width, camera.height), frame.orientation
    stored = orientation.upright_size(*size)  # which exchanges the sides back
    hidden = masks.hidden(frame.name, Raster(*stored, orientation), size)
    if hidden is None or lens is None:
        return frame.with_hidden(hidden)
    return frame.with_hidden(torch.from_numpy(lens.resampled(hidden.byte().numpy(), nearest=True)) > 0)


def masked_sequence(frames: FrameSequence, masks: MaskFolder) -> FrameSequence:
    """Return a sequence whose frames hide what the masks in a folder hide.

    Raises ``InputError`` if no frame has a mask. For sequences without ``names``, such as streams, this is
    known only at the end and causes an ``InputWarning``.
    """
    names: Sequence[str] | None = getattr(frames, "names", None)
    if names is not None:
        masks.require_any(names)
    if not isinstance(frames, FileSequence):
        return _MaskedStream(frames, masks)
    return FileSequence(
        frames.path, [replace(entry, read=partial(_read, entry, masks)) for entry in frames.entries]
    )


def _read(entry: SequenceEntry, masks: MaskFolder) -> tuple[Frame, SE3 | None]:
    read: ReadFrame = entry.read
    frame, truth = read()
    return masked(frame, masks), truth


class _MaskedStream:
    """Frames decoded one after another, such as a video's, whose masks are named after them."""

    def __init__(self, frames: FrameSequence, masks: MaskFolder) -> None:
        self._frames, self._masks = frames, masks

    @property
    def path(self) -> Path:
        return self._frames.path

    def __len__(self) -> int:
        return len(self._frames)

    def __iter__(self) -> Iterator[TimedFrame]:
        names = list[str]()
        for timed in self._frames:
            names.append(timed.frame.name)
            yield replace(timed, frame=masked(timed.frame, self._masks))
        try:
            self._masks.require_any(names)
        except InputError as error:
            warnings.warn(str(error), InputWarning, stacklevel=2)
