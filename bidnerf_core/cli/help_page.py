"""Help pages: wrapped to the terminal, grouped like the settings, and without options that only experts need."""

from __future__ import annotations

import dataclasses
import functools
import inspect
import io
import re
import sys
import textwrap
import typing
from collections.abc import Callable, Mapping
from typing import Annotated, Any, TypeVar

import tyro

from bidnerf_core.settings import is_expert, to_flat

_T = TypeVar("_T")

PHRASES = {
    "At most one argument can be overridden.": "At most one of these can be given.",
    "Exactly one argument must be passed in.": "One of these must be given.",
}
"""Sentences of the parser about options that exclude each other, and what pages say instead."""


def without_expert_settings(function: Callable[..., _T]) -> tuple[Callable[..., _T], int]:
    """Return a function without the expert options, for a short help page, and the number of options left
    out.

    Settings are the parameters whose default is a dataclass. The parser removes hidden options altogether, so
    the returned function is only for the page: arguments are parsed with ``function`` itself.
    """
    shorter, left_out = dict[str, Any](), 0
    for name, parameter in inspect.signature(function).parameters.items():
        if dataclasses.is_dataclass(parameter.default):
            shorter[name], hidden = _short(parameter.default)
            left_out += hidden
    return retyped(function, shorter), left_out


def retyped(function: Callable[..., _T], defaults: Mapping[str, Any]) -> Callable[..., _T]:
    """Return the function with other defaults, whose types the parser also uses for the parameters."""
    signature, hints = inspect.signature(function), dict(function.__annotations__)
    parameters = dict(signature.parameters)
    for name, default in defaults.items():
        hints[name] = type(default)
        parameters[name] = parameters[name].replace(default=default, annotation=type(default))

    @functools.wraps(function)
    def changed(*arguments: Any, **options: Any) -> _T:
        return function(*arguments, **options)

    changed.__annotations__ = hints
    changed.__signature__ = signature.replace(parameters=list(parameters.values()))  # type: ignore[attr-defined]
    return changed


def _short(settings: Any) -> tuple[Any, int]:
    """Return the same settings as an instance of a type without the expert ones, and the number of hidden settings."""
    kind, hidden = type(settings), 0
    hints = typing.get_type_hints(kind, include_extras=True)
    notes, values = dict[str, Any](), dict[str, Any]()
    for field in dataclasses.fields(kind):
        value = getattr(settings, field.name)
        if is_expert(kind, field.name):
            notes[field.name] = Annotated[hints[field.name], tyro.conf.Suppress]
            hidden += len(to_flat(value)) if dataclasses.is_dataclass(value) else 1
        elif dataclasses.is_dataclass(value):
            value, inside = _short(value)
            notes[field.name], hidden = type(value), hidden + inside
        values[field.name] = value
    if not hidden:
        return settings, 0
    members = {"__annotations__": notes, "__doc__": kind.__doc__, "__module__": kind.__module__}
    defaults = {name: values[name] for name in notes}
    short: Any = dataclasses.dataclass(frozen=True)(type(kind.__name__, (kind,), members | defaults))
    return short(**values), hidden


class Page(io.StringIO):
    """A help page as printed by the parser, in which running text and usage are one long line each."""

    def isatty(self) -> bool:  # determines whether the page has colours
        return sys.__stdout__ is not None and sys.__stdout__.isatty()

    @property
    def encoding(self) -> str:  # type: ignore[override]  # determines the characters of boxes
        return getattr(sys.__stdout__, "encoding", None) or "ascii"

    def wrapped(self, width: int) -> str:
        """Return the page with lines of at most ``width`` characters, and short headings."""
        lines = [_quoted(_headed(line.rstrip())) for line in self.getvalue().splitlines()]
        return "".join(f"{_wrapped(line, width)}\n" for line in lines)


def _headed(line: str) -> str:
    """Return the heading of a box without outer group names: ``steps`` for ``config.by-colour.steps options``."""
    found = re.search(r"\bconfig\.([\w-]+\.)*(?=[\w-]+ options )", line)
    if found is None:
        return line
    edge = line.rindex("options ") + len("options ")
    return line[: found.start()] + line[found.end() : edge] + line[edge] * len(found[0]) + line[edge:]


def _quoted(line: str) -> str:
    """Return a line with plain quotes instead of the double backticks of docstrings, and with the words of other help pages
    for those of the parser, padded to keep the box width.
    """
    for theirs, ours in PHRASES.items():
        line = line.replace(theirs, ours.ljust(len(theirs)))
    cells = re.split(r"([│|])", line)
    return "".join(cell.replace("``", "'") + " " * cell.count("``") for cell in cells).rstrip()


def _wrapped(line: str, width: int) -> str:
    unseen = sum(map(len, re.findall(r"\x1b\[[0-9;]*m", line)))
    if len(line) - unseen <= width:
        return line
    return textwrap.fill(line, width + unseen, subsequent_indent="  " if "usage:" in line else "")
