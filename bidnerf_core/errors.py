"""Errors for a user's mistakes and warnings about assumptions: each is one line that names the file and the
problem.
"""

from __future__ import annotations

import difflib
from collections.abc import Collection, Sequence


class InputError(ValueError):
    """An input that cannot be used. The message is a single line that can be shown to the user unchanged."""


class UsageError(InputError):
    """Arguments contradict each other or are out of range, regardless of the files' contents."""


class InputWarning(UserWarning):
    """An input was ambiguous and a convention was assumed; the message is a single line that states which."""


class Cancelled(Exception):
    """Work stopped because ``cancel`` returned True. Partial results were saved where possible, and the
    message lists them.
    """


def unknown_name(what: str, name: str, known: Collection[str]) -> InputError:
    """Return the error for a name that is not among ``known``; it suggests the closest known spelling."""
    listed = f", expected one of {', '.join(known)}"
    return InputError(f"no {what} {name!r}{spelling_hint(name, known, listed)}")


def spelling_hint(name: str, known: Collection[str], otherwise: str = "") -> str:
    """Return a question that suggests the closest spelling among ``known``, or ``otherwise`` if none is
    similar.
    """
    near = difflib.get_close_matches(name, known, n=1)
    return f", did you mean {near[0]!r}?" if near else otherwise


def refuse_text(what: str, given: object) -> None:
    """Raise ``InputError`` if a single string is given where a list is expected: it would be read as a list
    of letters.
    """
    if isinstance(given, str):
        raise InputError(f"{what} is {given!r}, expected a list, such as [{given!r}]")


def amount(count: int, noun: str) -> str:
    """Return a count with its noun, in the plural unless the count is 1."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def enumeration(parts: Sequence[str]) -> str:
    """Join parts as in a sentence: a, b and c."""
    return " and ".join([*filter(None, [", ".join(parts[:-1])]), *parts[-1:]])


def printable(text: str) -> str:
    """Return ``text`` with a backslash escape in place of each character that could control the terminal.

    These are control, format and unassigned Unicode characters (such as ESC and the marks that reverse the
    writing direction), separators other than the space, and bytes that are not UTF-8. File and frame names
    may contain any of them.
    """
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)
