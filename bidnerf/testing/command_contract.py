"""The requirements on commands, with one test for each."""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
from collections.abc import Sequence
from typing import ClassVar
from unittest.mock import patch

from bidnerf.cli import COMMANDS, main
from bidnerf.testing.faults import Named, is_one_line, require
from bidnerf_core.registry import list_plugins

UNDESCRIBED = re.compile(r"^  (-\S+(?: [A-Z{\[]\S*)*|\[?[A-Z]{2}\S*)(?:\n(?! {6})|\n? {2,}\()", re.MULTILINE)
"""Matches an argument on a help page without a description, or with one that states only whether it is required."""


class CommandContract(Named):
    """Tests of a command; to use them, derive a class whose name begins with ``Test`` and set ``name``.

    ``name`` is the name under which the command is registered, ``arguments`` are words with which it succeeds in a short time; without
    them, the command is not run. If it has an option ``--json``, it is run with that option as well.
    """

    kind = "command"
    arguments: ClassVar[Sequence[str] | None] = None

    def test_summary_is_one_line(self) -> None:
        self._part(COMMANDS.load)
        (summary,) = [info.summary for info in list_plugins("commands") if info.name == self.name]
        require(self._who, (is_one_line(summary), f"summary is {summary!r}, expected a docstring that begins with one"))

    def test_help_describes_every_argument(self) -> None:
        for columns in (80, 120):
            with patch.dict(os.environ, COLUMNS=str(columns)):
                status, page, more = self._run("--help")
            bare = UNDESCRIBED.search(page)
            widest = max(page.splitlines(), key=len)
            require(
                f"{self._who}, --help",
                (status == 0 and more == "", f"exit status {status} and {more!r} on stderr, expected 0 and nothing"),
                (page.startswith(f"usage: bidnerf {self.name}"), f"begins with {page[:40]!r}, expected its usage"),
                (
                    bare is None,
                    f"does not describe {bare and bare[1]}, expected Option(METAVAR, help) in its annotation",
                ),
                (len(widest) <= columns, f"{widest!r} is wider than a terminal of {columns} columns"),
            )

    def test_unknown_option_is_refused_in_a_line(self) -> None:
        status, printed, more = self._run("--no-such-option")
        expected = "expected status 2 and one line on stderr that names it"
        require(
            f"{self._who}, an unknown option",
            (status == 2, f"exit status {status}, {expected}"),
            (printed == "" and more.count("\n") == 1 and "--no-such-option" in more, f"prints {more!r}, {expected}"),
        )

    def test_it_succeeds_and_prints_json_if_asked(self) -> None:
        if self.arguments is None:
            return
        status, _, more = self._run(*self.arguments)
        require(self._who, (status == 0, f"exit status {status} with {more!r}, expected 0"))
        if "--json" not in self._run("--help")[1]:
            return
        status, printed, more = self._run(*self.arguments, "--json")
        require(f"{self._who}, --json", (status == 0, f"exit status {status} with {more!r}, expected 0"))
        for line in printed.splitlines():
            try:
                json.loads(line)
            except ValueError as error:
                raise AssertionError(f"{self._who}, --json: {line!r} is not JSON, expected one value a line") from error

    def _run(self, *words: str) -> tuple[int, str, str]:
        """Run the command, and return its exit status and what it printed on stdout and stderr."""
        out, err = io.StringIO(), io.StringIO()
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            status = self._part(lambda name: main([name, *words]))
        return status, out.getvalue(), err.getvalue()
