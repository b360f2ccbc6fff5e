"""Commands run in this process, and what they printed."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, TypeAlias


class CommandResult(NamedTuple):
    """The exit status of a command, and what it wrote to stdout and stderr."""

    status: int
    out: str
    err: str


Run: TypeAlias = Callable[..., CommandResult]
"""The type of the fixture ``bidnerf``: runs a command whose words are the arguments."""
