"""Finding files from names that were written on another system.

Metadata files may use Windows separators, different case from the files, no image extension, or an absolute
path from another machine. The file is found anyway if the name is unambiguous.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path, PurePosixPath, PureWindowsPath

from bidnerf_core.io import HEIF_SUFFIXES, IMAGE_SUFFIXES, is_file

IMAGE_ENDINGS = ("", *IMAGE_SUFFIXES, *HEIF_SUFFIXES)


def posix_name(name: str) -> PurePosixPath:
    """Return a name with POSIX separators; backslashes are taken for those of Windows."""
    return PurePosixPath(PureWindowsPath(name).as_posix() if "\\" in name else name)


class FileNames:
    """The files below a folder, found by the names in a metadata file; each folder is listed at most once."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._listed: dict[Path, dict[str, str]] = {}

    def find(self, name: PurePosixPath, endings: tuple[str, ...] = ("",), moved: bool = False) -> Path | None:
        """Return the file named ``name`` plus one of the ``endings``, or None.

        The exact name is tried first, then names that differ in case, then the last parts of an absolute path, and of a
        relative one if it may be relative to a folder elsewhere because files were ``moved``.
        """
        for ending in endings:
            exact = self._folder / f"{name}{ending}"
            if is_file(exact):
                return exact
        for parts in self._tails(name, moved):
            for ending in endings:
                found = self._ignoring_case((*parts[:-1], f"{parts[-1]}{ending}"))
                if found is not None:
                    return found
        return None

    def _tails(self, name: PurePosixPath, moved: bool) -> list[tuple[str, ...]]:
        """Return the parts of a relative name; for an absolute one, or a ``moved`` one, the parts below each of its folders,
        longest first.
        """
        is_absolute = name.is_absolute() or bool(name.parts and name.parts[0].endswith(":"))
        last = len(name.parts) if is_absolute or moved else min(1, len(name.parts))
        return [name.parts[first:] for first in range(int(is_absolute), last)]

    def _ignoring_case(self, parts: tuple[str, ...]) -> Path | None:
        place = self._folder
        for part in parts:
            if part != "..":
                part = self._entries(place).get(part.lower(), part)
            place = place / part
        return place if is_file(place) else None

    def _entries(self, folder: Path) -> dict[str, str]:
        """Return the names in a folder by lower-case form, without those that differ only in case."""
        if folder not in self._listed:
            try:
                names = [child.name for child in folder.iterdir()]
            except OSError:
                names = []
            count = Counter(name.lower() for name in names)
            self._listed[folder] = {name.lower(): name for name in names if count[name.lower()] == 1}
        return self._listed[folder]
