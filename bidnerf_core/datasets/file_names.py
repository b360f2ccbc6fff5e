"""Finding files by names that were written on another system.

Metadata files may use Windows separators, different case from the files, another image extension or none, an absolute
path from another machine, or a folder that was renamed. The file is found anyway if the name is unambiguous.
"""

from __future__ import annotations

import os
import re
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping
from itertools import takewhile
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import TypeVar

from bidnerf_core.datasets.capture import Shot, warn_about
from bidnerf_core.frames import natural_order
from bidnerf_core.io import HEIF_SUFFIXES, IMAGE_SUFFIXES, is_file

Entry = TypeVar("Entry")
IMAGE_ENDINGS = ("", *IMAGE_SUFFIXES, *HEIF_SUFFIXES)
AUXILIARY = re.compile(
    r"(.*[_.-])?(depths?|masks?|conf(idence)?|thumb(nail)?s?|normals?|disp(arity)?|semantics?|segmentations?|labels?|instances?)"
    r"([_.-]?(vis\w*|colou?r\w*|maps?|images?|pngs?))?",
    re.IGNORECASE,
)
"""The names of folders of depth, masks, and pictures computed from photos."""


def is_auxiliary(folder: str) -> bool:
    """Return whether a folder of this name holds depth, masks or pictures computed from photos, rather than photos."""
    return AUXILIARY.fullmatch(folder) is not None


def posix_name(name: str) -> PurePosixPath:
    """Return a name with POSIX separators; backslashes are treated as Windows separators."""
    return PurePosixPath(PureWindowsPath(name).as_posix() if "\\" in name else name)


class FileNames:
    """Finds the files that a metadata file names, below ``folder`` or, failing that, below the ``others``.

    Each folder is listed at most once. With ``images``, the folder that the user names for the images, only that is searched.
    """

    def __init__(self, folder: Path, *others: Path, images: Path | None = None) -> None:
        self._root, self._remarked = folder if images is None else images, False
        self._folders = (
            [each for each in (folder, *others) if each == folder or each.is_dir()] if images is None else [images]
        )
        self._listed: dict[Path, tuple[set[str], dict[str, str]]] = {}
        self._images: dict[str, list[Path]] | None = None

    def find(self, name: str | PurePosixPath, endings: tuple[str, ...] = ("",), moved: bool = False) -> Path | None:
        """Return the file named ``name`` plus one of the ``endings``, or None.

        The exact name is tried first, then names that differ in case, then the trailing parts of an absolute path.
        With ``moved``, a relative path may refer to a folder elsewhere, so its trailing parts are tried as well.
        """
        name = posix_name(str(name))
        # All parts of a relative name have to match. Of an absolute or moved name, trailing parts are tried too, longest first.
        is_absolute = name.is_absolute() or bool(name.parts and name.parts[0].endswith(":"))
        last = len(name.parts) if is_absolute or moved else min(1, len(name.parts))
        tails = [name.parts[first:] for first in range(int(is_absolute), last)]
        for folder in self._folders:
            parent = folder / name.parent if len(name.parts) > 1 else folder
            exact, like = (parent, name.name), ((self._on_disk(folder, t[:-1]), t[-1]) for t in tails)
            for number, (parent, stem) in enumerate((exact, *like)):
                # Most names of a large file may be missing, so folders are listed instead of trying each ending.
                exact_names, unique = self._names(parent)
                for wanted in (f"{stem}{ending}" for ending in endings):
                    found = unique.get(wanted.lower(), wanted) if number else wanted
                    if found in exact_names and is_file(file := parent / found):
                        return file
        return None

    def path(self, name: str | PurePosixPath, moved: bool = False) -> Path:
        """Return the file that ``find`` returns or, if there is none, the path where it is expected."""
        return self.find(name, moved=moved) or self._folders[0] / posix_name(str(name))

    def image(self, name: str | PurePosixPath) -> Path:
        """Return the image named ``name``, or the path where it is expected.

        It may have another image extension, or lie in another folder below the first one, if there is only one such image; then
        the first such image is named in a remark.
        """
        listed = posix_name(str(name))
        found = self.find(listed, IMAGE_ENDINGS, moved=True)
        if found is None and (found := self._elsewhere(listed)) is None:
            return self._folders[0] / listed
        if not self._remarked and not any(str(found).startswith(str(folder / str(name))) for folder in self._folders):
            self._remarked = True
            warn_about(
                self._root, f"{str(name)!r} is taken for {os.path.relpath(found, self._root)}, and others likewise"
            )
        return found

    def shots(self, entries: Mapping[str, Entry], read: Callable[[Path, str, Entry], Shot]) -> list[Shot]:
        """Return the images that are listed by name, in natural order; ``read`` makes a shot of an existing file and its entry."""
        files = {name: self.image(name) for name in sorted(entries, key=natural_order)}
        return [read(f, name, entries[name]) if is_file(f) else Shot(image=f) for name, f in files.items()]

    def _elsewhere(self, name: PurePosixPath) -> Path | None:
        """Return the only image with the same name but for its extension and folders, those with most folders in common first."""
        if self._images is None:
            self._images = defaultdict(list)
            for folder, inside, files in os.walk(self._root):
                inside[:] = [each for each in inside if not each.startswith(".") and not is_auxiliary(each)]
                for file in map(Path(folder).joinpath, files):
                    if file.suffix.lower() in IMAGE_ENDINGS[1:]:
                        self._images[file.stem.lower()].append(file)
        stem = name.stem if name.suffix.lower() in IMAGE_ENDINGS[1:] else name.name

        def likeness(file: Path) -> tuple[int, bool]:
            parts = zip(reversed(file.parts[:-1]), reversed(name.parts[:-1]), strict=False)
            return sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], parts)), file.name == name.name

        found = self._images.get(stem.lower(), [])
        best = [file for file in found if likeness(file) == max(map(likeness, found))]
        return best[0] if len(best) == 1 else None

    def _on_disk(self, folder: Path, parts: tuple[str, ...]) -> Path:
        """Return the path of ``parts`` below a folder, each with the upper and lower case used on disk unless that is ambiguous."""
        for part in parts:
            folder = folder / (part if part == ".." else self._names(folder)[1].get(part.lower(), part))
        return folder

    def _names(self, folder: Path) -> tuple[set[str], dict[str, str]]:
        """Return the names in a folder, and those that are unambiguous by their lower case."""
        if folder not in self._listed:
            try:
                names = os.listdir(folder)
            except (OSError, ValueError):
                names = []
            count = Counter(name.lower() for name in names)
            self._listed[folder] = set(names), {n.lower(): n for n in names if count[n.lower()] == 1}
        return self._listed[folder]
