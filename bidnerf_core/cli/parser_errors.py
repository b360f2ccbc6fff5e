"""Error messages for arguments that the parser rejects: one line, as for every other mistake.

The parser (tyro) describes rejections through a hook that is not part of its stable interface. If a version lacks the
hook, or describes one in a way unknown here, the line is what the parser itself prints.
"""

from __future__ import annotations

import contextlib
import io
import re
import sys
import types
import typing
from collections.abc import Callable, Collection, Iterator, Sequence
from typing import Any

from bidnerf_core.errors import UsageError, amount, enumeration, spelling_hint

NUMBERS = {int: "a whole number", float: "a number"}
COLOURS = re.compile(r"\x1b\[[0-9;]*m")
BORDERS = "│|"
"""Characters between which the parser prints the rows of a message."""
WRONG = 2
"""The status with which the parser ends the program if it rejects the arguments."""


@contextlib.contextmanager
def refusals_in_a_line(
    name: str, arguments: Sequence[str], options: Callable[[], Collection[str]]
) -> Iterator[None]:
    """Raise ``UsageError`` if the parser rejects the ``arguments`` of the command ``name``.

    ``options`` returns the names of all options. What else the parser prints on stderr is passed on afterwards.
    """
    described = list[str]()

    def refused(event: Any) -> None:
        with contextlib.suppress(AttributeError, TypeError, LookupError):  # another version's event
            if (message := _message(event, arguments)) is not None:
                described.append(message)

    printed = io.StringIO()
    try:
        with contextlib.redirect_stderr(printed), _hooked(refused):
            yield
    except SystemExit as stopped:
        if stopped.code != WRONG:
            raise
        message = _unknown_option(arguments, options()) or [*described, _plain(printed.getvalue())][0]
        printed = io.StringIO()
        raise UsageError(f"{message}; '{name} --help' describes all arguments") from stopped
    finally:
        sys.stderr.write(printed.getvalue())


def _hooked(hook: Callable[[Any], None]) -> contextlib.AbstractContextManager[None]:
    """Let the parser call ``hook`` when it rejects arguments, if this version of it can."""
    try:
        from tyro import _errors
    except ImportError:
        return contextlib.nullcontext()
    register = getattr(_errors, "on_parse_error", None)
    return contextlib.nullcontext() if register is None else register(hook)


def _plain(text: str) -> str:
    """Return the first sentences of a message that the parser printed: in a box or, on plain terminals, between rules."""
    rows = [row.strip() for row in COLOURS.sub("", text).splitlines()]
    inside = [row.strip(BORDERS).strip() for row in rows if row[:1] in BORDERS and row[-1:] in BORDERS]
    is_boxed = any(inside)
    groups = [list[str]()]
    for row in inside if is_boxed else rows:
        if any(map(str.isalnum, row)):
            groups[-1].append(row)
        elif row and groups[-1]:
            groups.append([])
    said = [" ".join(group) for group in groups if group]
    return next(
        iter(said if is_boxed else said[1:] or said), "wrong arguments"
    )  # a box has its title in its border


def _unknown_option(arguments: Sequence[str], options: Collection[str]) -> str | None:
    for word in arguments:
        name = word.partition("=")[0].replace("_", "-")
        if name.startswith("--") and len(name) > 2 and name not in options:
            return f"no option {name!r}{spelling_hint(name, options)}"
    return None


def _message(event: Any, arguments: Sequence[str]) -> str | None:
    """Return what is wrong, or None for an event that is not known here."""
    kind = type(event).__name__
    if kind == "MissingArgs":
        missing = [f"{_name(each.arg)} ({_help(each.arg)})" for each in event.missing_arguments]
        return f"{enumeration(missing)} {'is' if len(missing) == 1 else 'are'} missing"
    if kind == "MissingMutexGroup":
        names = [_name(each.arg) for each in event.groups[0]]
        return f"one of {enumeration(names)} is missing"
    if kind == "MutexConflict":
        return f"{event.first_token} and {event.second_token} exclude each other, expected only one of them"
    if kind == "UnrecognizedArgs":
        return f"{amount(len(event.tokens), 'argument')} too many, from {event.tokens[0]!r} on"
    if kind == "BadValue" and event.reason == "too_few_values":
        return f"no value for {_name(event.argument)} ({_help(event.argument)})"
    if kind == "InvalidChoice":
        hint = spelling_hint(event.value, event.choices)
        listed = ", ".join(event.choices)
        return f"{_name(event.argument)} is {event.value!r}, expected one of {listed}{hint}"
    if kind == "InstantiationFailure":
        return str(event.message) if event.argument is None else _wrong_value(event.argument, arguments)
    return None


def _wrong_value(argument: Any, arguments: Sequence[str]) -> str:
    given = " ".join(_values(argument.lowered.name_or_flags, arguments))
    expected = _expected(argument.field.type_stripped) or argument.lowered.metavar
    return f"{_name(argument)} is {given!r}, expected {expected} ({_help(argument)})"


def _values(names: Sequence[str], arguments: Sequence[str]) -> list[str]:
    """Return the values given to an option; the last occurrence counts."""
    found: list[str] = []
    for place, word in enumerate(arguments):
        name, equals, value = word.partition("=")
        if name.replace("_", "-") in names:
            rest = arguments[place + 1 :]
            end = next((n for n, each in enumerate(rest) if each.startswith("--")), len(rest))
            found = [value] if equals else list(rest[:end])
    return found


def _expected(kind: Any) -> str | None:
    """Return a type in words, or None if its name in the help page says more."""
    if typing.get_origin(kind) in (typing.Union, types.UnionType):
        kinds = [each for each in typing.get_args(kind) if each is not type(None)]
        return _expected(kinds[0]) if len(kinds) == 1 else None
    return NUMBERS.get(kind)


def _name(argument: Any) -> str:
    """Return an option, or a positional argument as the help page calls it."""
    name = argument.lowered.metavar if argument.is_positional() else argument.lowered.name_or_flags[0]
    return str(name)


def _help(argument: Any) -> str:
    text = argument.field.helptext
    found = text() if callable(text) else text
    return " ".join((found or argument.lowered.metavar or "").split())
