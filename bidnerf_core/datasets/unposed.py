"""Photos without poses: where they lie in a folder, and what finds their poses (entry points of ``bidnerf.posers``)."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Protocol, runtime_checkable

from bidnerf_core.camera import Camera, CameraSource
from bidnerf_core.datasets.capture import warn_about
from bidnerf_core.datasets.reader import find_reader
from bidnerf_core.datasets.video import is_video
from bidnerf_core.errors import InputError, enumeration
from bidnerf_core.frames import natural_order, photos_in
from bidnerf_core.io import read_header
from bidnerf_core.registry import Plugins, interface_defects


@runtime_checkable
class PosedPhotos(Protocol):
    """The record that a poser returns."""

    @property
    def placed(self) -> int:
        """The number of photos with a pose."""
        ...


@runtime_checkable
class Poser(Protocol):
    """A function that finds the poses of photos without any, and writes them as a dataset."""

    def __call__(
        self,
        photos: str | Path,
        out: str | Path,
        camera: Camera | CameraSource | str | Path | None = None,
        overwrite: bool = False,
        *,
        reuse: bool = False,
    ) -> PosedPhotos:
        """Write a dataset of ``photos`` (a folder, or a video) and their poses into the folder ``out``.

        ``camera`` (intrinsics, a file of them, or a source of either) is kept fixed. ``overwrite`` is whether the folder may hold something
        else, ``reuse`` whether poses found earlier for the same photos are taken. Raises ``InputError`` if no poses can
        be found.
        """
        ...


POSERS: Plugins[Poser] = Plugins("posers", lambda poser: interface_defects(poser, (), {"__call__": ("photos", "out")}))
"""The posers by name."""


def lacks_poses(path: str | Path) -> bool:
    """Return whether a path is a video, or a folder of photos that no dataset reader recognizes."""
    below = Path(path)
    if find_reader(below) is not None:
        return False
    return bool(photos_below(below)) if below.is_dir() else is_video(below)


def photos_below(folder: Path, out: Path | None = None) -> list[Path]:
    """Return the photos of a folder in natural order of their names or, if it has none, those of its subfolders.

    Depth, masks and the like are left out, as are datasets, smaller copies of other photos, and the folder ``out``.
    """
    own, _ = photos_in(folder)
    if own:
        return own
    found = _without_copies(folder, list(_subfolders(folder, out)))
    return sorted(found, key=lambda file: natural_order(file.relative_to(folder).as_posix()))


def _without_copies(folder: Path, photos: Sequence[Path]) -> list[Path]:
    """Return the photos without smaller copies of others, as in ``images_2`` and ``images_4`` beside ``images``.

    A folder holds copies if a folder beside it has larger photos of the same names and aspect ratio; a remark names
    such folders.
    """
    groups: dict[Path, list[Path]] = {}
    for photo in photos:
        groups.setdefault(photo.parent, []).append(photo)
    copies, alike = list[Path](), dict[tuple[Path, frozenset[str]], list[tuple[int, int, Path]]]()
    for below, group in groups.items():
        with contextlib.suppress(InputError):  # raised again when that photo is read
            header = read_header(group[0])
            key = below.parent, frozenset(photo.stem for photo in group)
            alike.setdefault(key, []).append((header.width, header.height, below))
    for sized in alike.values():
        whole_width, whole_height, _ = max(sized)
        for width, height, below in sized:
            # Sizes are rounded.
            if width < whole_width and abs(height - width * whole_height / whole_width) <= 1:
                copies.append(below)
    if copies:
        warn_about(
            folder,
            f"{enumeration([str(below.relative_to(folder)) for below in copies])}: smaller copies of the photos beside"
            " them, which are left out",
        )
    return [photo for photo in photos if photo.parent not in copies]


def _subfolders(folder: Path, out: Path | None) -> Iterator[Path]:
    """Yield the photos in subfolders of ``folder`` at any depth, except those of datasets."""
    for below, inside, _ in os.walk(folder):
        inside[:] = sorted(
            name
            for name in inside
            if not name.startswith(".")
            and name.lower() not in ("depth", "depths", "mask", "masks", "confidence", "conf", "thumbnails")
            and not (out is not None and out.exists() and Path(below, name).samefile(out))
        )
        if Path(below) != folder:
            if find_reader(Path(below)) is not None:
                inside.clear()
                continue
            yield from photos_in(below)[0]
