"""Recordings with missing files: the files present are used, and the missing ones are counted in one remark."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeVar

from bidnerf_core.errors import InputError, InputWarning, amount

F = TypeVar("F")


def remark(where: Path | str, text: str) -> None:
    """Issue a one-line ``InputWarning`` about what was assumed or left out in ``where``."""
    warnings.warn(f"{where}: {text}", InputWarning, stacklevel=3)


def present(
    frames: Sequence[F],
    is_there: Callable[[F], bool],
    where: Path | str,
    name: Callable[[F], object],
    error: Callable[[F], InputError] | None = None,
    noun: str = "image",
) -> list[F]:
    """Return the frames whose files exist. A remark counts the others, with the ``name`` of the first missing
    file.

    If nothing is left, the ``error`` of the first frame is raised, if there is one.
    """
    there = [frame for frame in frames if is_there(frame)]
    if len(there) < len(frames):
        first = next(frame for frame in frames if not is_there(frame))
        if not there and error is not None:
            raise error(first)
        gone = len(frames) - len(there)
        are = "is" if gone == 1 else "are"
        remark(
            where,
            f"{gone} of {amount(len(frames), noun)} {are} missing and left out, first: {name(first)}",
        )
    return there
