"""What several commands share."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import tyro
from rich.console import Console

from bidnerf_core.datasets import Dataset
from bidnerf_core.errors import InputError
from bidnerf_core.frames import View

T = TypeVar("T")

console = Console(stderr=True, highlight=False, soft_wrap=True)
"""Everything that is not the result goes here."""


def parse(command: str, function: Callable[..., T], arguments: list[str]) -> T:
    """Call ``function`` with what the arguments say; wrong usage ends the program with status 2."""
    return tyro.cli(
        function,
        args=arguments,
        prog=f"bidnerf {command}",
        config=(tyro.conf.FlagCreatePairsOff, tyro.conf.OmitArgPrefixes),
    )


def say(message: str) -> None:
    console.print(message, markup=False)


def print_json(value: Any) -> None:
    json.dump(value, sys.stdout, allow_nan=False)
    sys.stdout.write("\n")


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


def check_free(out: Path, overwrite: bool) -> None:
    """An output that exists is left alone unless the user says otherwise."""
    if out.exists() and not overwrite and (out.is_file() or any(out.iterdir())):
        raise InputError(f"{out}: exists already; name another --out or pass --overwrite")
    if out.is_file():
        raise InputError(f"{out}: is a file, expected the name of a folder")


def make_folder(out: Path) -> None:
    """Create an output folder and make sure, before hours of work, that it can be written."""
    out.mkdir(parents=True, exist_ok=True)
    probe = out / ".writable"
    probe.write_bytes(b"")
    probe.unlink()


def value_of(option: str, arguments: Sequence[str]) -> str | None:
    """The value of an option before the parser that needs it exists."""
    for place, argument in enumerate(arguments):
        if argument.startswith(option + "="):
            return argument[len(option) + 1 :]
        if argument == option and place + 1 < len(arguments):
            return arguments[place + 1]
    return None
