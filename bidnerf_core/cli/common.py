"""Parsing, messages, and output folders, shared by several commands."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import json
import math
import os
import shutil
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias, TypeVar

import tyro
from rich.console import Console
from rich.segment import Segment, Segments
from rich.table import Table
from rich.text import Text

from bidnerf_core.cli.help_page import Page, without_expert_settings
from bidnerf_core.cli.text import PrintableStream, printable
from bidnerf_core.errors import InputError
from bidnerf_core.io.files import is_temporary, temporary

if sys.platform != "win32":
    import fcntl

if TYPE_CHECKING:
    from bidnerf_core.datasets import Dataset
    from bidnerf_core.frames.frame import View
else:
    Dataset = View = Any  # their modules import torch, which commands such as 'backends' do not need

_T = TypeVar("_T")

DEFAULT_BACKEND = "hashgrid"
LARGEST_SEED = 2**31 - 1


class _Progress(Console):
    """A console that becomes silent when its reader goes away, so that work continues."""

    def on_broken_pipe(self) -> None:
        self.quiet = True


console = _Progress(stderr=True, highlight=False, soft_wrap=True)
"""The console for everything but the result: progress, remarks, errors."""


class UsageError(InputError):
    """The arguments contradict each other. The exit status is that of wrong usage, 2, and not that of bad input, 1."""

    status = 2


def option(metavar: str | None, help: str, default: str | None = None) -> Any:
    """Describe an option for the help page; ``default`` explains in words a default value such as None."""
    hint = None if default is None else default and f"(default: {default})"
    return tyro.conf.arg(metavar=metavar, help=help, help_behavior_hint=hint)


MapFolder: TypeAlias = Annotated[
    Path, tyro.conf.Positional, option("MAP", "folder of a map, as 'bidnerf train' writes it")
]
Device: TypeAlias = Annotated[str, option("NAME", "device on which the field computes: cpu, cuda ...")]
DataFolder: TypeAlias = Annotated[Path, tyro.conf.Positional, option("DATA", "folder of a dataset")]
Flag: TypeAlias = Annotated[bool, tyro.conf.FlagCreatePairsOff]
Names: TypeAlias = Annotated[tuple[tuple[str, ...], ...], tyro.conf.UseAppendAction]
"""``--frame a b --frame c`` names three frames."""


def parse(command: str, function: Callable[..., _T], arguments: list[str]) -> _T:
    """Call ``function`` with the parsed arguments; wrong usage ends the program with status 2.

    ``--help`` shows all options except settings that are marked ``EXPERT``, and ``--help-all`` shows those as well.
    """
    if "--help-all" in arguments:
        return _show_help(command, function, 0)
    if {"-h", "--help"} & set(arguments):
        return _show_help(command, *without_expert_settings(function))
    return _called(command, _of_finite_settings(function), arguments)


def _called(command: str, function: Callable[..., _T], arguments: list[str]) -> _T:
    odd = any(printable(word) != word for word in arguments)
    # The parser repeats the arguments in its messages, which may be coloured, but must not let them control the terminal.
    with contextlib.redirect_stderr(PrintableStream(sys.stderr)) if odd else contextlib.nullcontext():
        return tyro.cli(
            function, args=arguments, prog=f"bidnerf {command}", config=(tyro.conf.OmitArgPrefixes,)
        )


def _show_help(command: str, function: Callable[..., _T], hidden: int) -> _T:
    page = Page()
    try:
        with contextlib.redirect_stdout(page):
            return _called(command, function, ["--help"])
    finally:
        if hidden:
            page.write(f"\n{hidden} settings for experts are not shown; --help-all shows them.\n")
        sys.stdout.write(page.wrapped(shutil.get_terminal_size().columns))


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
            raise UsageError(f"--{field.name.replace('_', '-')} is {value}, expected a finite number")
        _require_finite(value)


def say(message: str) -> None:
    """Print a line on stderr."""
    console.print(printable(message), markup=False)


def show(line: str) -> None:
    """Print a line of the result on stdout."""
    sys.stdout.write(printable(line) + "\n")


def print_json(value: Any) -> None:
    """Print one line of strict JSON, completely or not at all."""
    sys.stdout.write(json.dumps(value, allow_nan=False) + "\n")


def print_table(table: Table) -> None:
    """Print a table on stdout."""
    screen = Console(highlight=False, markup=False)
    parts = [
        part if part.text.strip("\n") == "" else Segment(printable(part.text), part.style, part.control)
        for part in screen.render(table)
    ]
    with (
        screen.capture() as drawn
    ):  # written below, since rich has its own way of handling a reader that goes away
        screen.print(Segments(parts), end="")
    sys.stdout.write(drawn.get())


def require(what: str, value: float, least: float, most: float = math.inf) -> None:
    """Check a number from the command line. Raises ``UsageError`` where it is out of range."""
    if not least <= value <= most:
        expected = f"{least} or more" if most == math.inf else f"{least} to {most}"
        raise UsageError(f"{what} is {value}, expected {expected}")


def require_different(what: str, names: Sequence[str]) -> None:
    """Check that no name is listed twice. Raises ``UsageError``."""
    twice = [name for name, count in Counter(names).items() if count > 1]
    if twice:
        raise UsageError(f"{what} names {twice[0]} more than once, expected each once")


def read_views(dataset: Dataset, split: str, names: Sequence[str] | None = None) -> list[View]:
    """Read views of a split, with a progress display if they are many. Raises ``InputError`` for an empty split."""
    total = len(dataset.frame_names(split)) if names is None else len(names)
    if total == 0:
        raise InputError(f"{dataset.path}: split {split!r} has no frames")
    if total <= 10:
        return dataset.views(split, names)
    with console.status("") as status:
        return dataset.views(
            split,
            names,
            lambda done, count: status.update(
                Text(printable(f"reading {dataset.path.name}/{split}: {done}/{count}"))
            ),
        )


class FolderInUse(InputError):
    """Another process is writing into the folder."""


@contextlib.contextmanager
def output_folder(out: Path, overwrite: bool) -> Iterator[None]:
    """Create a folder, and check before hours of work that it can be written and that no other process writes into it.

    A folder that is not empty is rejected unless ``overwrite`` is set. If the work fails before anything is in the folder, the
    folder is removed again, with the parents that were created for it. Raises ``InputError``.
    """
    _check_free(out, overwrite)
    made = [folder for folder in (out, *out.parents) if not folder.exists()]
    try:
        _make_writable(out)
        with locked(out):
            _check_free(out, overwrite)  # another process may have finished meanwhile
            yield
    except FolderInUse:  # the folder belongs to the other process
        raise
    except BaseException:
        with contextlib.suppress(OSError):  # not empty, or never made
            for folder in made:
                folder.rmdir()
        raise


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Hold a lock on a folder, which the system releases even if the process is killed.

    Raises ``FolderInUse`` where another process holds it. On Windows, and on file systems without locks, nothing is locked.
    """
    if sys.platform == "win32":
        yield
        return
    number = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(number, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise FolderInUse(
                f"{folder}: another bidnerf writes into it, expected another --out, or to wait for its end"
            ) from error
        except OSError:  # a file system without locks
            pass
        yield
    finally:
        os.close(number)


def _check_free(out: Path, overwrite: bool) -> None:
    if out.exists() and not out.is_dir():
        raise InputError(f"{out}: is a file, expected the name of a folder")
    if out.is_dir() and not overwrite and not all(map(_is_leftover, out.iterdir())):
        from bidnerf_core.cli.opened_map import unfinished

        what = unfinished(out) or "exists already and is not empty"
        raise InputError(f"{out}: {what}; name another --out or pass --overwrite")


def _is_leftover(file: Path) -> bool:
    """Return whether the file was left behind by a process that was killed before the map was complete."""
    from bidnerf_core.maps.storage import DESCRIPTION, OURS

    of_map = OURS.fullmatch(file.name) is not None and not (file.parent / DESCRIPTION).exists()
    return of_map or is_temporary(file.name)


def _make_writable(out: Path) -> None:
    try:
        out.mkdir(parents=True, exist_ok=True)
        probe = temporary(out / "writable")
        probe.write_bytes(b"")
        probe.unlink()
    except OSError as error:
        raise InputError(
            f"{out}: cannot be written ({error.strerror}), expected a folder that can be made and written"
        ) from error


@contextlib.contextmanager
def wrong_usage() -> Iterator[None]:
    """Turn an ``InputError`` into a ``UsageError``, where the arguments are wrong whatever the files contain."""
    try:
        yield
    except InputError as error:
        raise UsageError(str(error)) from error


def value_of(option: str, arguments: Sequence[str]) -> str | None:
    """Return the value of an option on which the parser itself depends; the last occurrence counts, as for the parser."""
    found = None
    for place, argument in enumerate(arguments):
        if argument.startswith(option + "="):
            found = argument[len(option) + 1 :]
        elif argument == option and place + 1 < len(arguments):
            found = arguments[place + 1]
    return found
