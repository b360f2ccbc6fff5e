"""Interruptions of what writes files: in the first system call that writes, in the second, and so on."""

from __future__ import annotations

import errno
import itertools
import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

FULL = OSError(errno.ENOSPC, "No space left on device")


class Stopped(BaseException):
    """An interruption such as Ctrl-C, which is no ``Exception``."""


def outcomes(
    attempt: Callable[[], object], error: BaseException, more: Sequence[tuple[Any, str]] = ()
) -> Iterator[BaseException | None]:
    """What ``attempt`` raises when ``error`` strikes in its first system call that writes, in its second ..., until
    there is no such call left.
    """
    for number in itertools.count():
        calls: list[object] = []
        with pytest.MonkeyPatch.context() as patch:
            for owner, name in ((Path, "open"), (Path, "replace"), (os, "fsync"), *more):
                patch.setattr(owner, name, striking(getattr(owner, name), calls, number, error))
            try:
                attempt()
                raised = None
            except (OSError, Stopped) as caught:
                raised = caught
        yield raised
        if len(calls) <= number:
            return


def striking(call: Callable[..., Any], calls: list[object], number: int, error: BaseException) -> Callable[..., Any]:
    """Return ``call`` with ``error`` in place of its call number ``number``; opening a file to read it is not counted."""

    def wrapper(*arguments: Any, **options: Any) -> Any:
        if call.__name__ == "open" and "wb" not in arguments:
            return call(*arguments, **options)
        calls.append(call)
        if len(calls) == number + 1:
            raise error
        return call(*arguments, **options)

    return wrapper
