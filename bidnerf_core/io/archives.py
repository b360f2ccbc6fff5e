"""Zip archives whose members are read one at a time, within limits; no archive is unpacked as a whole."""

from __future__ import annotations

import zipfile
import zlib
from functools import partial
from pathlib import Path

from bidnerf_core.errors import InputError, amount
from bidnerf_core.io.files import PackedFile, open_binary

LARGEST_MEMBER = 256 * 2**20
"""Default limit on the unpacked size of a member (bytes). A small archive can hold members that unpack to any size."""
DAMAGES = (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, ValueError, OSError)
"""Exceptions that the standard library raises for archives that are damaged or of an unsupported kind."""


class Archive:
    """The members of a zip archive by name. Raises ``InputError`` if the file is not a complete zip archive."""

    def __init__(self, path: Path, expected: str = "a zip archive", largest_member: int = LARGEST_MEMBER) -> None:
        """Open the archive at ``path``. ``largest_member`` limits the unpacked size of a member (bytes)."""
        self.path, self._expected, self._largest = path, expected, largest_member
        with open_binary(path, expected) as file:
            begins = file.read(2)
        try:
            self._zip = zipfile.ZipFile(path)
            members = self._zip.infolist()
        except DAMAGES as error:
            raise InputError(
                "ends too early, probably an incomplete copy" if begins == b"PK" else f"is not a zip archive ({error})",
                where=path,
                expected=expected,
            ) from error
        self._members = {member.filename: member for member in members}

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
        try:
            with self._zip.open(member) as file:
                content = file.read(min(member.file_size, self._largest) + 1)
        except (*DAMAGES, RuntimeError) as error:
            raise InputError(f"cannot be unpacked ({error})", where=where, expected=self._expected) from error
        if max(member.file_size, len(content)) > self._largest:
            found, most = (f"{size / 2**20:,.0f} MiB" for size in (member.file_size, self._largest))
            raise InputError(f"unpacks to {found}", where=where, expected=f"at most {most}")
        return content
