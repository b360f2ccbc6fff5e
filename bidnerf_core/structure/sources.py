"""The input of structure from motion: photos of a folder and its subfolders, and videos."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from bidnerf_core.datasets import VIDEO_SUFFIXES, find_reader, is_video, no_dataset, remark, unique_names
from bidnerf_core.errors import InputError, enumeration
from bidnerf_core.frames import natural_order, photos_in
from bidnerf_core.io import open_binary, read_header


@dataclass(frozen=True)
class SourceImage:
    """A photo, or a frame of a video that was written as an image."""

    name: str  # unique among the images: the stem, prefixed with as many folders as needed
    file: Path
    time: float | None = None  # seconds, of a frame of a video


def lacks_poses(path: str | Path) -> bool:
    """Return whether a path is a video, or a folder of photos that no dataset reader recognizes."""
    place = Path(path)
    if find_reader(place) is not None:
        return False
    return bool(_listed(place, None)) if place.is_dir() else is_video(place)


def photos_of(folder: Path, out: Path | None = None) -> list[SourceImage]:
    """Return the photos of a folder in natural name order.

    If the folder itself has none, those of its subfolders are used, except for depth, masks and the like, and
    ``out``. Raises ``InputError`` if there is no such folder, if there are no photos, and if poses are known.
    """
    if not folder.exists():
        raise InputError("no such file or folder", where=folder, expected="photos or a video")
    if not folder.is_dir():
        raise InputError(
            "is a file", where=folder, expected=f"a folder of photos or a video ({', '.join(VIDEO_SUFFIXES)})"
        )
    reader = find_reader(folder)
    if reader is not None:
        raise InputError(
            f"is a dataset whose poses are known ({reader.expected}); train with it directly, or give only"
            " the folder of the photos to find their poses again",
            where=folder,
        )
    files = _listed(folder, out)
    if not files:
        raise no_dataset(folder)
    names = unique_names([(*file.relative_to(folder).parts[:-1], file.stem) for file in files])
    return [SourceImage(name, file) for name, file in zip(names, files, strict=True)]


def _listed(folder: Path, out: Path | None) -> list[Path]:
    own, _ = photos_in(folder)
    if own:
        return own
    found = _without_copies(folder, list(_below(folder, out)))
    return sorted(found, key=lambda file: natural_order(file.relative_to(folder).as_posix()))


def _without_copies(folder: Path, photos: Sequence[Path]) -> list[Path]:
    """Return the photos without smaller copies of others, as in ``images_2`` and ``images_4`` beside ``images``.

    Copies have the names of the others and their aspect ratio, all of one folder; a remark names their folders.
    """
    groups: dict[Path, list[Path]] = {}
    for photo in photos:
        groups.setdefault(photo.parent, []).append(photo)
    sizes = dict[Path, tuple[int, int]]()
    for place, group in groups.items():
        with contextlib.suppress(InputError):  # raised again when that photo is read
            header = read_header(group[0])
            sizes[place] = header.width, header.height

    def is_copy(place: Path, other: Path) -> bool:
        (width, height), (whole_width, whole_height) = sizes[place], sizes[other]
        # Sizes are rounded.
        smaller = width < whole_width and abs(height - width * whole_height / whole_width) <= 1
        names = [{photo.stem for photo in groups[each]} for each in (place, other)]
        return smaller and place.parent == other.parent and names[0] == names[1]

    copies = [place for place in sizes if any(is_copy(place, other) for other in sizes)]
    if copies:
        names = enumeration([str(place.relative_to(folder)) for place in copies])
        remark(folder, f"{names}: smaller copies of the photos beside them, which are left out")
    return [photo for photo in photos if photo.parent not in copies]


def refuse_panoramas(photos: Sequence[SourceImage]) -> None:
    """Raise ``InputError`` for panoramas, which no pinhole camera takes; photos that are twice as wide as high cause a remark."""
    wide = 0
    for photo in photos:
        try:
            header = read_header(photo.file)
        except InputError:  # left out later
            continue
        if header.width != 2 * header.height:
            continue
        wide += 1
        with open_binary(photo.file, "a photo") as file:
            # So many bytes contain the XMP: a segment has at most 64 KiB, and EXIF precedes it.
            if b"equirectangular" in file.read(2**18):
                expected = (
                    "poses with camera_model EQUIRECTANGULAR in transforms.json, or pinhole views cut from it"
                )
                raise InputError("is a panorama (equirectangular)", where=photo.file, expected=expected)
    if photos and wide == len(photos):
        text = "photos are twice as wide as high; if they are panoramas, they are no pinhole images and no poses fit them"
        remark(photos[0].file.parent, text)


def _below(folder: Path, out: Path | None) -> Iterator[Path]:
    """Yield the photos in subfolders of ``folder`` at any depth, except those of datasets."""
    for place, inside, _ in os.walk(folder):
        inside[:] = sorted(
            name
            for name in inside
            if not name.startswith(".")
            and name.lower() not in ("depth", "depths", "mask", "masks", "confidence", "conf", "thumbnails")
            and not (out is not None and out.exists() and Path(place, name).samefile(out))
        )
        if Path(place) != folder:
            if find_reader(Path(place)) is not None:
                inside.clear()
                continue
            yield from photos_in(place)[0]
