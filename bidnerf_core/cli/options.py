"""Parsing of a command's arguments: options shared by several commands, their checks, and the help page."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import io
import math
import os
import re
import shutil
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, TypeAlias, TypeVar

import tyro

from bidnerf_core.cli.help_page import Page, retyped, without_expert_settings
from bidnerf_core.cli.parser_errors import refusals_in_a_line
from bidnerf_core.errors import InputError, UsageError

_T = TypeVar("_T")

DEFAULT_BACKEND = "hashgrid"
OPTION = re.compile(r"(?<![\w-])--[a-z][a-z0-9-]*")
LEAST_WIDTH = 40
"""Minimum line width of help, even in narrower terminals."""


def option(metavar: str | None, help: str, default: str | None = None) -> Any:
    """Describe an option for the help page; ``default`` explains a default value such as None in words."""
    hint = None if default is None else default and f"(default: {default})"
    return tyro.conf.arg(metavar=metavar, help=help, help_behavior_hint=hint)


MapFolder: TypeAlias = Annotated[
    Path, tyro.conf.Positional, option("MAP", "folder of a map, as written by 'bidnerf train'")
]
FeaturesName: TypeAlias = Annotated[
    str, option("NAME", "detector of the landmarks, one of 'bidnerf plugins features'")
]
Device: TypeAlias = Annotated[str, option("NAME", "device on which the field computes: cpu, cuda ...")]
Largest: TypeAlias = Annotated[
    int | None,
    option("PX", "longer side to which larger images are downscaled", "1600, or less if memory is short"),
]
DataFolder: TypeAlias = Annotated[
    Path, tyro.conf.Positional, option("DATA", "folder of a dataset, or a .r3d file")
]
Flag: TypeAlias = Annotated[bool, tyro.conf.FlagCreatePairsOff]
Names: TypeAlias = Annotated[tuple[tuple[str, ...], ...], tyro.conf.UseAppendAction]
"""``--frame a b --frame c`` names three frames."""


def parse(command: str, function: Callable[..., _T], arguments: list[str], config: Any = None) -> _T:
    """Call ``function`` with the parsed arguments; wrong usage ends the program with status 2.

    ``config`` holds the default settings if their type is known only at run time, such as those of the method
    or backend named in the arguments: the parameter ``config`` of ``function`` then takes its type and
    default from them. ``--help`` shows all options except settings marked ``EXPERT``, and ``--help-all``
    shows those as well.
    """
    if config is not None:
        function = retyped(function, {"config": config})
    if "--help-all" in arguments:
        return _show_help(command, function, 0)
    if {"-h", "--help"} & set(arguments):
        return _show_help(command, *without_expert_settings(function))
    return _called(command, _of_finite_settings(function), arguments)


def _called(command: str, function: Callable[..., _T], arguments: list[str]) -> _T:
    @functools.wraps(function)
    def parsed(*given: Any, **options: Any) -> Callable[[], _T]:
        return lambda: function(*given, **options)

    name = f"bidnerf {command}"
    with _wide_enough(), refusals_in_a_line(name, arguments, lambda: _options_of(command, function)):
        call = tyro.cli(parsed, args=arguments, prog=name, config=(tyro.conf.OmitArgPrefixes,))
    return call()


def _options_of(command: str, function: Callable[..., Any]) -> set[str]:
    """Return the names of a command's options, from its help page."""
    page = io.StringIO()
    with contextlib.redirect_stdout(page), contextlib.suppress(SystemExit):
        _called(command, function, ["--help"])
    return set(OPTION.findall(page.getvalue()))


@contextlib.contextmanager
def _wide_enough() -> Iterator[None]:
    """Give the parser's help and messages a minimum width: in narrower terminals it never finishes breaking lines."""
    before = os.environ.get("COLUMNS")
    width = shutil.get_terminal_size().columns
    if width < LEAST_WIDTH:
        os.environ["COLUMNS"] = str(LEAST_WIDTH)
    try:
        yield
    finally:
        if before is not None:
            os.environ["COLUMNS"] = before
        elif width < LEAST_WIDTH:
            del os.environ["COLUMNS"]


def _show_help(command: str, function: Callable[..., _T], hidden: int) -> _T:
    page = Page()
    try:
        with contextlib.redirect_stdout(page):
            return _called(command, function, ["--help"])
    finally:
        if hidden:
            page.write(f"\n{hidden} expert settings are not shown; --help-all shows them.\n")
        sys.stdout.write(page.wrapped(max(LEAST_WIDTH, shutil.get_terminal_size().columns)))


def _of_finite_settings(function: Callable[..., _T]) -> Callable[..., _T]:
    """Return the function with a check that its settings are finite: training would otherwise fail hours later."""

    @functools.wraps(function)
    def checked(*arguments: Any, **options: Any) -> _T:
        for value in (*arguments, *options.values()):
            _require_finite(value)
        return function(*arguments, **options)

    return checked


def _require_finite(settings: Any) -> None:
    if not dataclasses.is_dataclass(settings):
        return
    for field in dataclasses.fields(settings):
        value = getattr(settings, field.name)
        if isinstance(value, float) and not math.isfinite(value):
            raise UsageError(f"--{field.name.replace('_', '-')} is {value}", expected="a finite number")
        _require_finite(value)


def require(what: str, value: float, least: float, most: float = math.inf) -> None:
    """Check a number from the command line. Raises ``UsageError`` if it is out of range."""
    if not least <= value <= most:
        expected = f"{least} or more" if most == math.inf else f"{least} to {most}"
        raise UsageError(f"{what} is {value}", expected=expected)


def require_different(what: str, names: Sequence[str]) -> None:
    """Check that no name is listed twice. Raises ``UsageError``."""
    twice = [name for name, count in Counter(names).items() if count > 1]
    if twice:
        raise UsageError(f"{what} names {twice[0]} more than once", expected="each once")


@contextlib.contextmanager
def wrong_usage() -> Iterator[None]:
    """Convert an ``InputError`` to a ``UsageError`` if the arguments are wrong regardless of the files' contents."""
    try:
        yield
    except InputError as error:
        raise UsageError(error) from error


def value_of(option: str, arguments: Sequence[str]) -> str | None:
    """Return the value of an option on which the parser itself depends; the last occurrence counts, as for the parser."""
    found = None
    for place, argument in enumerate(arguments):
        if argument.startswith(option + "="):
            found = argument[len(option) + 1 :]
        elif argument == option and place + 1 < len(arguments):
            found = arguments[place + 1]
    return found
