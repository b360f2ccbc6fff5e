"""Errors for a user's mistakes and warnings about assumptions: each is one line that names the file and the finding."""

from __future__ import annotations

import difflib
from collections.abc import Collection, Sequence


class InputError(ValueError):
    """An input is not usable; the message is one line that can be shown to the user as it is."""


class UsageError(InputError):
    """Arguments contradict each other or are out of range, whatever the files contain."""


class InputWarning(UserWarning):
    """An input was ambiguous and a convention was assumed; the message is one line that states which."""


class Cancelled(Exception):
    """Work stopped because its ``cancel`` returned True; what could be kept was saved, and the message says what."""


def unknown_name(what: str, name: str, known: Collection[str]) -> InputError:
    """Return the error for a name that is not among ``known``; it suggests the known name with the most similar spelling."""
    listed = f", expected one of {', '.join(known)}"
    return InputError(f"no {what} {name!r}{spelling_hint(name, known, listed)}")


def spelling_hint(name: str, known: Collection[str], otherwise: str = "") -> str:
    """Return a question that suggests the most similarly spelt of the ``known`` names, or ``otherwise`` if none is similar."""
    near = difflib.get_close_matches(name, known, n=1)
    return f", did you mean {near[0]!r}?" if near else otherwise


def refuse_text(what: str, given: object) -> None:
    """Raise ``InputError`` for one text where a list of texts is expected: each of its letters would count as one."""
    if isinstance(given, str):
        raise InputError(f"{what} is {given!r}, expected a list, such as [{given!r}]")


def amount(count: int, noun: str) -> str:
    """Return a number with its noun, which takes an s unless the number is 1."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def enumeration(parts: Sequence[str]) -> str:
    """Return parts as they are listed in a sentence: a, b and c."""
    return " and ".join([*filter(None, [", ".join(parts[:-1])]), *parts[-1:]])


def printable(text: str) -> str:
    """Return ``text`` with a backslash escape in place of each character that could control the terminal.

    These are Unicode's control, format and unassigned characters, such as ESC or the marks that reverse the direction of
    writing, separators other than the blank, and bytes that are not UTF-8. Names of files and of frames may contain any of
    them.
    """
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)
