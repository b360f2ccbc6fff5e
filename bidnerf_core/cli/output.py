"""Output of commands: progress and remarks on stderr, results on stdout."""

from __future__ import annotations

import io
import json
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, TextIO

from rich.console import Console
from rich.segment import Segment, Segments
from rich.table import Table
from rich.text import Text

from bidnerf_core.errors import InputError, printable

if TYPE_CHECKING:
    from bidnerf_core.datasets import Dataset
    from bidnerf_core.frames import View
else:
    Dataset = View = Any  # their modules import torch, which commands such as 'backends' do not need


class _Progress(Console):
    """A console that falls silent when its pipe is closed, so that work continues."""

    def on_broken_pipe(self) -> None:
        self.quiet = True


console = _Progress(stderr=True, highlight=False, soft_wrap=True)
"""The console for everything except results: progress, remarks, errors."""


def say(message: str) -> None:
    """Print a line on stderr."""
    console.print(printable(message), markup=False)


def show(line: str) -> None:
    """Print one line of the result on stdout."""
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
    with screen.capture() as drawn:  # written below, since rich handles a closed pipe in its own way
        screen.print(Segments(parts), end="")
    sys.stdout.write(drawn.get())


def read_views(dataset: Dataset, split: str, names: Sequence[str] | None = None) -> list[View]:
    """Read the views of a split, with a progress display if there are many. Raises ``InputError`` for an empty split."""
    from bidnerf_core.datasets import with_all  # imported here, since it imports torch

    dataset = with_all(dataset, split)
    total = len(dataset.frame_names(split)) if names is None else len(names)
    if total == 0:
        raise InputError(f"split {split!r} has no frames", where=dataset.path)
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


class PrintableStream(io.TextIOBase):
    """A stream that passes on written text, line by line, as ``printable`` text."""

    def __init__(self, stream: TextIO | io.TextIOBase) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        self._stream.write("\n".join(map(printable, text.split("\n"))))
        return len(text)

    def flush(self) -> None:
        self._stream.flush()

    def isatty(self) -> bool:
        return False  # no colours, which are control characters
