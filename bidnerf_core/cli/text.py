"""Text for a terminal, with only the standard library, so that commands that do not need torch start at once."""

from __future__ import annotations

import io
from typing import TextIO


def printable(text: str) -> str:
    """Return ``text`` with a backslash escape in place of each character that could control the terminal.

    These are Unicode's control, format and unassigned characters, such as ESC or the marks that reverse the direction of
    writing, separators other than the blank, and bytes that are not UTF-8. Names of files and of frames may contain any of
    them.
    """
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


class PrintableStream(io.TextIOBase):
    """A stream that passes on what is written to it, line by line, as ``printable`` text."""

    def __init__(self, stream: TextIO | io.TextIOBase) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        self._stream.write("\n".join(map(printable, text.split("\n"))))
        return len(text)

    def flush(self) -> None:
        self._stream.flush()

    def isatty(self) -> bool:
        return False  # no colours, which are control characters
