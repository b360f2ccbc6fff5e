"""Zip archives whose members are read one at a time, within limits; no archive is unpacked as a whole."""

from __future__ import annotations

import zipfile
import zlib
from functools import partial
from pathlib import Path

from bidnerf_core.errors import InputError, amount
from bidnerf_core.io.allowance import Allowance
from bidnerf_core.io.files import PackedFile, library_errors, open_binary

DAMAGES = (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, ValueError, OSError)
"""Exceptions that the standard library raises for archives that are damaged or of an unsupported kind."""


class Archive:
    """The members of a zip archive by name. Raises ``InputError`` if the file is not a complete zip archive."""

    def __init__(self, path: Path, expected: str = "a zip archive") -> None:
        """Open the archive at ``path``; ``expected`` briefly describes it."""
        self.path, self._expected = path, expected
        with open_binary(path, expected) as file:
            begins = file.read(2)
        found = "ends too early, probably an incomplete copy" if begins == b"PK" else "is not a zip archive"
        with library_errors(path, found, expected, *DAMAGES):
            self._zip = zipfile.ZipFile(path)
            self._members = {member.filename: member for member in self._zip.infolist()}

    @property
    def names(self) -> list[str]:
        """The names of the members, in the order of the archive."""
        return list(self._members)

    @property
    def unpacked_size(self) -> int:
        """The total size of all members after unpacking (bytes)."""
        return sum(member.file_size for member in self._zip.infolist())

    def __contains__(self, name: str) -> bool:
        return name in self._members

    def file(self, name: str) -> PackedFile:
        """Return a member as a file, whose content is read only when it is opened."""
        return PackedFile(f"{self.path}/{name}", partial(self.read, name))

    def read(self, name: str) -> bytes:
        """Return the content of a member. Raises ``InputError`` if it is missing, damaged, encrypted or too large."""
        where, member = f"{self.path}/{name}", self._members.get(name)
        if member is None:
            raise InputError(f"not found in the archive, which holds {amount(len(self._members), 'file')}", where=where)
        Allowance.of(self.path, self._expected, where).take(member.file_size)
        with library_errors(where, "cannot be unpacked", self._expected, *DAMAGES, RuntimeError):
            return self._zip.read(member)  # no more than it declares
