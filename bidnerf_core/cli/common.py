"""What several commands share."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import io
import json
import math
import re
import shutil
import sys
import textwrap
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, TypeAlias, TypeVar

import tyro
from rich.console import Console
from rich.table import Table

from bidnerf_core.datasets import Dataset
from bidnerf_core.errors import InputError
from bidnerf_core.frames import View
from bidnerf_core.localization import find_method
from bidnerf_core.localization.methods import Method

T = TypeVar("T")

DEFAULT_BACKEND = "hashgrid"
LARGEST_SEED = 2**31 - 1


class _Progress(Console):
    def on_broken_pipe(self) -> None:
        """Work goes on when nobody watches it any more."""
        self.quiet = True


console = _Progress(stderr=True, highlight=False, soft_wrap=True)
"""Everything that is not the result goes here."""


class UsageError(InputError):
    """The arguments contradict each other: wrong usage, where other bad input has status 1."""

    status = 2


def option(metavar: str | None, help: str, default: str | None = None) -> Any:
    """How an option is shown; ``default`` in words where the value itself would tell a reader nothing."""
    hint = None if default is None else default and f"(default: {default})"
    return tyro.conf.arg(metavar=metavar, help=help, help_behavior_hint=hint)


MapFolder: TypeAlias = Annotated[
    Path, tyro.conf.Positional, option("MAP", "folder of a map, as 'bidnerf train' writes it")
]
DataFolder: TypeAlias = Annotated[Path, tyro.conf.Positional, option("DATA", "folder of a dataset")]
Flag: TypeAlias = Annotated[bool, tyro.conf.FlagCreatePairsOff]
Names: TypeAlias = Annotated[tuple[tuple[str, ...], ...], tyro.conf.UseAppendAction]
"""``--frame a b --frame c``: nothing that was named is forgotten."""


def parse(command: str, function: Callable[..., T], arguments: list[str]) -> T:
    """Call ``function`` with what the arguments say; wrong usage ends the program with status 2."""

    def call() -> T:
        config = (tyro.conf.OmitArgPrefixes,)
        return tyro.cli(
            _of_finite_settings(function), args=arguments, prog=f"bidnerf {command}", config=config
        )

    if not {"-h", "--help"} & set(arguments):
        return call()
    page = _Page()
    try:
        with contextlib.redirect_stdout(page):
            return call()
    finally:
        sys.stdout.write(page.wrapped(shutil.get_terminal_size().columns))


def _of_finite_settings(function: Callable[..., T]) -> Callable[..., T]:
    """The same, called with settings that are numbers; what is not would be found out hours later, or never."""

    @functools.wraps(function)
    def judged(*arguments: Any, **options: Any) -> T:
        for value in (*arguments, *options.values()):
            _require_finite(value)
        return function(*arguments, **options)

    return judged


def _require_finite(settings: Any) -> None:
    if not dataclasses.is_dataclass(settings):
        return
    for field in dataclasses.fields(settings):
        value = getattr(settings, field.name)
        if isinstance(value, float) and not math.isfinite(value):
            raise UsageError(f"--{field.name.replace('_', '-')} is {value}, expected a finite number")
        _require_finite(value)


class _Page(io.StringIO):
    """A help page. The parser leaves lines of running text and of usage as long as they are."""

    def isatty(self) -> bool:  # what decides on colours
        return sys.__stdout__ is not None and sys.__stdout__.isatty()

    @property
    def encoding(self) -> str:  # type: ignore[override]  # what decides on the lines of boxes
        return getattr(sys.__stdout__, "encoding", None) or "ascii"

    def wrapped(self, width: int) -> str:
        lines = self.getvalue().splitlines()
        return "".join(f"{_wrapped(line.rstrip(), width)}\n" for line in lines)


def _wrapped(line: str, width: int) -> str:
    unseen = sum(map(len, re.findall(r"\x1b\[[0-9;]*m", line)))
    if len(line) - unseen <= width:
        return line
    return textwrap.fill(line, width + unseen, subsequent_indent="  " if "usage:" in line else "")


def say(message: str) -> None:
    console.print(message, markup=False)


def print_json(value: Any) -> None:
    """One line of strict JSON, whole or not at all."""
    sys.stdout.write(json.dumps(value, allow_nan=False) + "\n")


def print_table(table: Table) -> None:
    screen = Console(highlight=False, markup=False)
    with screen.capture() as drawn:  # printed by us: rich has ways of its own when the reader goes away
        screen.print(table)
    sys.stdout.write(drawn.get())


def require(what: str, value: float, least: float, most: float = math.inf) -> None:
    """Judge a number that the command line was given."""
    if not least <= value <= most:
        expected = f"{least} or more" if most == math.inf else f"{least} to {most}"
        raise UsageError(f"{what} is {value}, expected {expected}")


def require_different(what: str, names: Sequence[str]) -> None:
    """No name may stand in a list twice."""
    twice = [name for name, count in Counter(names).items() if count > 1]
    if twice:
        raise UsageError(f"{what} names {twice[0]} more than once, expected each once")


def read_views(dataset: Dataset, split: str, names: Sequence[str] | None = None) -> list[View]:
    """Views of a split with a word on stderr while many are read; an empty split is an error."""
    total = len(dataset.frame_names(split)) if names is None else len(names)
    if total == 0:
        raise InputError(f"{dataset.path}: split {split!r} has no frames")
    if total <= 10:
        return dataset.views(split, names)
    with console.status("") as status:
        return dataset.views(
            split,
            names,
            lambda done, count: status.update(f"reading {dataset.path.name}/{split}: {done}/{count}"),
        )


@contextlib.contextmanager
def output_folder(out: Path, overwrite: bool) -> Iterator[None]:
    """Create a folder and make sure, before hours of work, that it can be written.

    One that holds something already is left alone unless the user says otherwise. If the work fails before anything is
    in the folder, it goes away again, with the parents that were made for it.
    """
    _check_free(out, overwrite)
    made = [folder for folder in (out, *out.parents) if not folder.exists()]
    try:
        _make_writable(out)
        yield
    except BaseException:
        with contextlib.suppress(OSError):  # not empty, or never made
            for folder in made:
                folder.rmdir()
        raise


def _check_free(out: Path, overwrite: bool) -> None:
    if out.exists() and not out.is_dir():
        raise InputError(f"{out}: is a file, expected the name of a folder")
    if out.is_dir() and not overwrite and any(out.iterdir()):
        raise InputError(f"{out}: exists already and is not empty; name another --out or pass --overwrite")


def _make_writable(out: Path) -> None:
    try:
        out.mkdir(parents=True, exist_ok=True)
        probe = out / ".writable"
        probe.write_bytes(b"")
        probe.unlink()
    except OSError as error:
        raise InputError(
            f"{out}: cannot be written ({error.strerror}), expected a folder that can be made and written"
        ) from error


def chosen_method(arguments: Sequence[str], usual: str) -> Method:
    """What ``--method`` names."""
    with wrong_usage():
        return find_method(value_of("--method", arguments) or usual)


@contextlib.contextmanager
def wrong_usage() -> Iterator[None]:
    """What is found in here is wrong with the arguments by themselves, whatever is in the files."""
    try:
        yield
    except InputError as error:
        raise UsageError(str(error)) from error


def value_of(option: str, arguments: Sequence[str]) -> str | None:
    """The value of an option before the parser that needs it exists; the last one counts, as for the parser."""
    found = None
    for place, argument in enumerate(arguments):
        if argument.startswith(option + "="):
            found = argument[len(option) + 1 :]
        elif argument == option and place + 1 < len(arguments):
            found = arguments[place + 1]
    return found
