"""Errors that users can correct, and warnings about assumptions; each one-line message names the file and the problem."""

from __future__ import annotations

import contextlib
import difflib
import re
from collections.abc import Callable, Collection, Iterator, Sequence


class InputError(ValueError):
    """Raised for an input that cannot be used.

    The message names settings as Python does, in backticks; programs with other names for them use ``spelled``.

    The message is a single line, ``where: found, expected ...``, which can be shown to the user unchanged, since it is
    made ``printable`` whatever names and text of files it repeats; its parts are attributes: ``where`` is the file, frame, argument or setting that is wrong, or None if the message does not begin
    with one; ``found`` is what was found there, or the whole problem; ``expected`` is what was expected, with any advice
    that follows, or None if the message does not say. If ``found`` ends in a colon or a semicolon, no comma is added.
    ``InputError(error, where=path)`` adds context to ``error``: ``path`` is put before ``error.where``, and the other
    parts are unchanged.
    """

    def __init__(self, found: object = "", *, where: object = None, expected: object = None) -> None:
        parts = [where]
        if isinstance(found, InputError):
            parts.append(found.where)
            expected, found = found.expected if expected is None else expected, found.found
        self.where: str | None = ": ".join(single_line(part) for part in parts if part) or None
        self.found: str = single_line(found)
        self.expected: str | None = None if expected is None else single_line(expected)
        problem = self.found
        if self.expected is not None:
            comma = "" if problem.endswith((":", ";")) or not problem else ","
            problem = f"{problem}{comma} expected {self.expected}".lstrip()
        super().__init__(f"{self.where}: {problem}" if self.where else problem)


@contextlib.contextmanager
def errors_in(where: object) -> Iterator[None]:
    """Raise an ``InputError`` of the block with ``where`` put before its own place, see ``InputError``."""
    try:
        yield
    except InputError as error:
        raise InputError(error, where=where) from error


class UsageError(InputError):
    """Raised for arguments that contradict each other or are out of range, whatever the files contain."""


class InputWarning(UserWarning):
    """Warning that an input is ambiguous; the message is a single line that states the convention that was assumed."""

    def __init__(self, message: object = "") -> None:
        super().__init__(single_line(message))


class Cancelled(Exception):
    """Raised when work stops because ``cancel`` returned True. The message states what was saved, if anything."""


def unknown_name(what: str, name: str, known: Collection[str]) -> InputError:
    """Return an error for a name that is not in ``known``; its message suggests the closest name or lists all."""
    hint = spelling_hint(name, known)
    return InputError(f"no {what} {name!r}{hint}", expected=None if hint else f"one of {', '.join(known)}")


def spelling_hint(name: str, known: Collection[str], otherwise: str = "") -> str:
    """Return ``, did you mean 'NAME'?`` with the closest name in ``known``, or ``otherwise`` if none is similar."""
    # The first letter is rarely mistyped, and names that differ in it are rarely meant.
    alike = [other for other in known if other.lstrip("-")[:1].lower() == name.lstrip("-")[:1].lower()]
    near = difflib.get_close_matches(name, alike, n=1)
    return f", did you mean {near[0]!r}?" if near else otherwise


def spelled(message: str, spell: Callable[[str], str] = str) -> str:
    """Return a message in which ``spell`` has written the name of each setting, which stands in backticks."""
    return re.sub(r"`(\w+)`", lambda name: spell(name[1]), message)


def amount(count: int, noun: str) -> str:
    """Return a count with its noun, in the plural unless the count is 1."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def enumeration(parts: Sequence[str], most: int | None = None) -> str:
    """Join parts with commas and a final "and", as in a sentence: a, b and c; if there are more than ``most``: a, b and 7 more."""
    if most is not None and len(parts) > most:
        parts = [*parts[:most], f"{len(parts) - most} more"]
    return " and ".join([*filter(None, [", ".join(parts[:-1])]), *parts[-1:]])


def printable(text: str) -> str:
    """Return ``text`` with a backslash escape in place of each character that could control the terminal.

    These are control, format and unassigned Unicode characters (such as ESC and the marks that reverse the
    writing direction), separators other than the space, and bytes that are not UTF-8. File and frame names
    may contain any of them.
    """
    if text.isprintable():  # nearly always, and long texts are looked through a hundred times faster this way
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def single_line(text: object) -> str:
    """Return ``text`` as one ``printable`` line."""
    return printable(" ".join(str(text).splitlines()))
