"""Output of commands: progress and remarks on stderr, results on stdout."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from typing import Any

from rich.console import Console

from bidnerf_core.errors import printable


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


def print_table(columns: Sequence[str], rows: Sequence[Sequence[str]], wide: str | None = None) -> None:
    """Print a table on stdout. On narrow terminals the column ``wide`` is folded, by words, and the others are kept whole."""
    from rich.table import Table

    screen = Console(highlight=False, markup=False)
    table = Table(box=None, pad_edge=False, show_header=any(columns))
    for column in columns:
        table.add_column(column, no_wrap=wide is not None and column != wide, overflow="fold")
    for row in rows:
        table.add_row(*map(printable, row))
    with screen.capture() as drawn:  # written below, since rich handles a closed pipe in its own way
        screen.print(table)
    sys.stdout.write(drawn.get())
