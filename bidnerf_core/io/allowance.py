"""The bound on the memory that the content of a file may take once it is unpacked, decoded or allocated."""

from __future__ import annotations

from pathlib import Path

from bidnerf_core.errors import InputError
from bidnerf_core.io.files import PackedFile

FREE = 512 * 2**20
"""Bytes that a file of any size may take."""
TIMES = 64
"""Further bytes for each byte of the file: more than splats, photos and sparse depth expand by."""


class Allowance:
    """The bytes that the content of a file may take: half a gigabyte, and 64 times the size of the file.

    A small file can hold or declare data of any size: compressed, shared by several entries, or not stored at all. Code that reads
    such a file calls ``take`` with the size of each part before it unpacks the part or allocates memory for it.
    """

    def __init__(self, where: object, expected: str, most: int) -> None:
        """Allow ``most`` bytes. ``where`` and ``expected`` are parts of the error: the file, and what it should be."""
        self.where, self.expected, self.left, self.most = where, expected, most, most

    @staticmethod
    def of(path: Path | PackedFile, expected: str, where: object = None) -> Allowance:
        """Return the allowance of a file or a folder of files, or of the part of it that ``where`` names in messages.

        What a member of an archive may take does not depend on the member's size.
        """
        size = 0
        if isinstance(path, Path):
            size = sum(file.stat().st_size for file in (path.iterdir() if path.is_dir() else [path]))
        return Allowance(where or path, expected, FREE + TIMES * size)

    def take(self, size: int) -> None:
        """Count ``size`` further bytes. Raises ``InputError`` if the file may not take that many."""
        self.left -= size
        if self.left < 0:
            taken, most = (f"{count / 2**20:,.0f} MiB" for count in (self.most - self.left, self.most))
            raise InputError(
                f"unpacks to {taken}", where=self.where, expected=f"{self.expected} of at most {most} in memory"
            )
