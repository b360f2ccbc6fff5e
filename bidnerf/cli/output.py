"""Output of commands: progress and remarks on stderr, results on stdout, and the files and folders that they write."""

from __future__ import annotations

import json
import os
import sys
import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from bidnerf.cli.program import option_name
from bidnerf_core.errors import InputError, UsageError, printable, spelled


class _Progress(Console):
    """A console that stops printing when its pipe is closed, so that the work continues."""

    def on_broken_pipe(self) -> None:
        self.quiet = True


console = _Progress(stderr=True, highlight=False, soft_wrap=True)
"""The console for everything except results: progress, remarks, errors."""


def say(message: str) -> None:
    """Print a line on stderr, with the options of the settings that it names."""
    console.print(printable(spelled(message, option_name)), markup=False)


def show(line: str) -> None:
    """Print one line of the result on stdout."""
    sys.stdout.write(printable(line) + "\n")


def print_json(value: Any) -> None:
    """Print a value as one line of strict JSON, completely or not at all."""
    sys.stdout.write(json.dumps(value, allow_nan=False) + "\n")


def print_result(value: Any, lines: Iterable[str], json: bool) -> None:
    """Print a result on stdout: ``value`` as a line of JSON, or as ``lines`` for readers."""
    if json:
        print_json(value)
    else:
        for line in lines:
            show(line)


def print_table(columns: Sequence[str], rows: Sequence[Sequence[str]], wide: str | None = None) -> None:
    """Print a table on stdout. On narrow terminals, the column ``wide`` is wrapped at words and the other columns are kept whole."""
    from rich.table import Table

    screen = Console(highlight=False, markup=False)
    table = Table(box=None, pad_edge=False, show_header=any(columns))
    for column in columns:
        table.add_column(column, no_wrap=wide is not None and column != wide, overflow="fold")
    for row in rows:
        table.add_row(*map(printable, row))
    with screen.capture() as drawn:  # written below, since rich handles a closed pipe in its own way
        screen.print(table)
    sys.stdout.write("".join(f"{line.rstrip()}\n" for line in drawn.get().splitlines()))


# Files and folders are checked before any work, and never replace an input.


def check_output(
    out: Path, inputs: Iterable[Path | str | None], overwrite: bool, endings: Sequence[str] = ("",)
) -> None:
    """Raise an error, before any work is done, if the file ``out`` cannot be written or would replace an input.

    Inputs are the files of any map, the ``inputs``, and the files in folders among the ``inputs``. Raises
    ``UsageError`` if the name has none of the ``endings`` or if ``out`` would replace an input, and ``InputError`` if
    ``out`` is a folder, if its folder does not exist or is not writable, or if ``out`` exists and ``overwrite`` is not
    set.
    """
    if not out.name.lower().endswith(tuple(endings)):
        raise UsageError(where=out, expected=f"a name that ends with {' or '.join(endings)}")
    # os.path functions return False for a name that is too long, which is reported when it is written.
    if os.path.isdir(out) or not os.path.isdir(out.parent):
        state = "is a file" if os.path.exists(out.parent) else "does not exist"
        found = "is a folder" if os.path.isdir(out) else f"its folder {out.parent} {state}"
        raise InputError(found, where=out, expected="a file in an existing folder")
    require_outside_maps(out.parent, out)
    _require_writable(out.parent, out)
    if not os.path.exists(out):
        return
    for given in [Path(each) for each in inputs if each is not None]:
        if given.exists() and out.samefile(given):
            raise UsageError("is an input of this command", where=out, expected="another name for its output")
        if given.is_dir() and out.resolve().is_relative_to(given.resolve()):
            raise UsageError(
                f"is a file in the input {given};", where=out, expected="a new name, or remove the file first"
            )
    if not overwrite:
        raise InputError("exists already; name another file, or overwrite it (`overwrite`)", where=out)


def check_folder(
    out: Path, inputs: Iterable[Path | str | None], may_be_map: bool = False, create: bool = False
) -> None:
    """Raise ``UsageError`` if an output folder lies inside a map, is one of the inputs, or is a map and ``may_be_map`` is not set.

    If ``create`` is set, the folder is created. Raises ``InputError`` if the folder, or files in it, cannot be
    created.
    """
    require_outside_maps(out.parent, out)
    if not may_be_map:
        require_outside_maps(out, out)
    for given in [Path(each) for each in inputs if each is not None]:
        if out.exists() and given.exists() and out.samefile(given):
            raise UsageError("is an input of this command", where=out, expected="another folder for its output")
    if create:
        try:
            out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(error.strerror, where=out, expected="a folder that can be created") from error
        _require_writable(out, out)


def require_outside_maps(folder: Path, out: Path) -> None:
    """Raise ``UsageError`` if ``folder``, which is the output ``out`` or its parent folder, is a map."""
    from bidnerf_core.maps import DESCRIPTION

    if (folder / DESCRIPTION).exists():
        reason = "exists already, as a map" if folder == out else "lies in the folder of a map"
        raise UsageError(reason, where=out, expected="a name outside of it")


def _require_writable(folder: Path, out: Path) -> None:
    try:
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        expected = "a folder in which files can be created"
        raise InputError(f"cannot be written: {error.strerror}", where=out, expected=expected) from error
