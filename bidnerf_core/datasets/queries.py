"""Images to localize: photos, or frames of a dataset, each read on demand."""

from __future__ import annotations

import copy
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol, runtime_checkable

from bidnerf_core.datasets.capture import Capture
from bidnerf_core.datasets.formats.photos import PhotoShot
from bidnerf_core.datasets.options import AS_STORED
from bidnerf_core.datasets.reader import DatasetOptions, file_of_dataset, no_dataset
from bidnerf_core.datasets.video import VIDEO_SUFFIXES
from bidnerf_core.errors import InputError, InputWarning, UsageError, amount, enumeration
from bidnerf_core.frames import DEPTH_STEM, Frame, View, photos_in
from bidnerf_core.geometry import SE3
from bidnerf_core.io import looks_like_image
from bidnerf_core.progress import log


@dataclass(frozen=True, eq=False)
class Query:
    """One image, or several with known relative poses, of which the last one is to be localized."""

    name: str
    views: tuple[View, ...]
    truth: SE3 | None = None  # T_world_camera if the dataset has it; used only for errors and perturbed starts
    file: Path | None = None  # of the last image

    @property
    def frame(self) -> Frame:
        """The image to be localized."""
        return self.views[-1].frame


@runtime_checkable
class QuerySource(Protocol):
    """A source of named queries that are read one at a time."""

    @property
    def names(self) -> Sequence[str]: ...

    def read(self, index: int) -> Query:
        """Read the query with index ``index``. Raises ``InputError`` if any of its files is missing or unusable."""
        ...


class Photos:
    """Image files, each of which is a query. ``depth`` maps photos that have depth to their depth files.

    If the ``options`` set no background, the background of the map in which a photo is localized is used.
    """

    def __init__(
        self,
        files: Sequence[Path],
        options: DatasetOptions = AS_STORED,
        depth: Mapping[Path, Path] | None = None,
    ) -> None:
        self._depth, self._remarks = depth or {}, set[str]()
        sensor = options.sensor("register_depth")
        self.capture = Capture(
            Path("photos"),
            [
                PhotoShot(
                    image=file,
                    camera=options.camera_source,
                    depth_image=self._depth.get(file),
                    depth_unit=options.depth_unit,
                    sensor=sensor,
                    awaits_background=options.background is None,
                )
                for file in files
            ],
            options.colour,
        )
        if (masks := options.mask_folder) is not None:
            self.capture = self.capture.with_masks(masks, by_stem=True)

    def select(self, indices: Sequence[int]) -> Photos:
        """Return only some of the photos."""
        chosen = copy.copy(self)
        chosen.capture = replace(self.capture, shots=[self.capture.shots[index] for index in indices])
        return chosen

    @property
    def names(self) -> Sequence[str]:
        return self.capture.names

    def read(self, index: int) -> Query:
        """Read the query with index ``index``. Raises ``InputError`` if any of its files is missing or unusable.

        The source of the photo's camera and any assumptions are logged, unless already logged for an earlier photo.
        """
        shot = self.capture.shots[index]
        if self._depth and shot.file not in self._depth:
            log.info("%s: no measured depth was given; colour only", shot.name)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", InputWarning)
            frame = self.capture[index].frame
        texts = [str(warning.message) for warning in caught]
        for text in [*(text.partition(": ")[2] or text for text in texts), f"{frame.camera_source}"]:
            if text not in self._remarks:
                log.info("%s: %s", shot.name, text)
            self._remarks.add(text)
        return Query(frame.name, (View(frame, SE3.identity()),), None, shot.file)


class DatasetFrames:
    """Dataset frames as queries: the frames ``names`` or, without names, those of a split.

    Each is localized on its own or, with ``rig``, together with the others as one rig, of which the last frame is to be
    localized. With a ``window``, the rig of each frame is that frame and the ``window - 1`` frames before it. Raises
    ``InputError`` for an unknown name, a split without frames and a window that is longer than the split.
    """

    def __init__(
        self,
        dataset: Capture,
        split: str = "test",
        names: tuple[str, ...] = (),
        window: int = 1,
        rig: bool = False,
    ) -> None:
        self.capture, self._split = dataset, split
        listed = dataset.frame_names(split)
        if not listed:
            raise InputError(f"split {split!r} has no frames", where=dataset.path)
        if window > len(listed):
            raise InputError(
                f"`window` is {window}", expected=f"1 to {len(listed)}, the number of frames in split {split!r}"
            )
        dataset.select(split, names)  # raises for an unknown name
        self._rigs = [names] if rig else [(name,) for name in names or listed]
        if window > 1:
            ends = [1 + listed.index(name) for (name,) in self._rigs]
            self._rigs = [tuple(listed[max(0, end - window) : end]) for end in ends]
            for *before, name in self._rigs:
                if window > 1 + len(before):
                    log.info(
                        f"`window` {window}: {name} has only {len(before)} before it in split {split!r}; a rig of"
                        f" {1 + len(before)}"
                    )

    def select(self, indices: Sequence[int]) -> DatasetFrames:
        """Return only some of the rigs."""
        chosen = copy.copy(self)
        chosen._rigs = [self._rigs[index] for index in indices]
        return chosen

    @property
    def names(self) -> Sequence[str]:
        return [rig[-1] for rig in self._rigs]

    def read(self, index: int) -> Query:
        """Read the query with index ``index``. Raises ``InputError`` if any of its files is missing or unusable."""
        rig = self._rigs[index]
        views, (shot,) = (
            tuple(self.capture.views(self._split, rig)),
            self.capture.select(self._split, rig[-1:]),
        )
        return Query(views[-1].frame.name, views, views[-1].T_ref_camera, shot.file)


def photo_files(paths: Sequence[Path], depth: Sequence[Path] = ()) -> list[Path]:
    """Return the files among ``paths`` and the images in the folders among them; other files in these folders are logged.

    Files of ``depth`` may lie among the photos. Raises ``InputError`` for a folder without photos.
    """
    files = list[Path]()
    for path in paths:
        if not path.is_dir():
            if (instead := file_of_dataset(path)) is not None and not looks_like_image(path):
                raise InputError(instead, where=path)
            if path.suffix.lower() in VIDEO_SUFFIXES:
                raise InputError("is a video", where=path, expected="photos; 'bidnerf track' takes videos")
            files.append(path)
            continue
        found, others = photos_in(path)
        others = [file for file in others if file not in depth]
        if not found:
            raise no_dataset(path)
        if others:
            log.info(f"{path}: skipped {enumeration([file.name for file in others], 5)}: not photos by their names")
        files += found
    return files


def depth_files(photos: Sequence[Path], depth: Sequence[Path]) -> dict[Path, Path]:
    """Return each photo's depth file, matched by name if names agree (``NAME.png``, ``NAME.depth.png``), else by order.

    Raises ``UsageError`` if the depth files cannot be matched in either way.
    """
    if not depth:
        return {}
    by_stem = {photo.stem: photo for photo in photos}
    stems = [file.stem.removesuffix(DEPTH_STEM) for file in depth]
    if len(by_stem) == len(photos) and len(set(stems)) == len(stems) and set(stems) <= set(by_stem):
        return {by_stem[stem]: file for stem, file in zip(stems, depth, strict=True)}
    if len(depth) != len(photos):
        raise UsageError(
            f"`depth` names {amount(len(depth), 'file')} for {amount(len(photos), 'photo')}",
            expected="one for each, in the same order or matched by name",
        )
    return dict(zip(photos, depth, strict=True))
