"""Commands run in this process or in one of their own, and what they printed."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias


class CommandResult(NamedTuple):
    """The exit status of a command, and what it wrote to stdout and stderr."""

    status: int
    out: str
    err: str

    def succeed(self) -> CommandResult:
        """Return the result of a command whose status must be 0."""
        assert self.status == 0, self.err
        return self


Run: TypeAlias = Callable[..., CommandResult]
"""The type of the fixture ``bidnerf``: runs a command whose words are the arguments."""


def assert_refused(found: CommandResult, status: int, *named: object, after_remarks: bool = False) -> None:
    """Assert that a command printed one line alone, on stderr, which names all of ``named``.

    With ``after_remarks``, that line is the last one, and others may stand before it.
    """
    assert (found.status, found.out) == (status, ""), found
    *remarks, line = found.err.splitlines() or [""]
    assert after_remarks or not remarks, found.err
    assert line.startswith("bidnerf "), line
    assert [str(what) for what in named if str(what) not in line] == [], line


def strict(text: str) -> Any:
    """Return the object of exactly one line, which is JSON without NaN."""

    def refuse(constant: str) -> None:
        raise AssertionError(f"{constant} is not JSON")

    assert text.count("\n") == 1
    assert text.endswith("\n")
    return json.loads(text, parse_constant=refuse)


def quietly(command: list[str], **options: object) -> str:
    """Standard output of a command; what it said, where it fails."""
    done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, **options)  # type: ignore[call-overload]
    assert done.returncode == 0, done.stdout + done.stderr
    return str(done.stdout)
