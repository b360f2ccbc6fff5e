"""Files and folders that commands write: they are checked before any work, and never replace what a command reads."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

from bidnerf_core.errors import InputError, UsageError

PLOTS = ".png", ".svg"
"""The endings of the names of plots."""


def check_output(out: Path, inputs: Iterable[Path | str | None]) -> None:
    """Raise, before any work is done, where the file ``out`` cannot be written, or would replace what is read.

    That is a file of any map, one of the ``inputs``, or a file in a folder among them. Raises ``UsageError`` for these, and
    ``InputError`` for a folder, and for a name in a folder that does not exist.
    """
    # Functions of os.path return False for a name that is too long, which is reported when it is written.
    if os.path.isdir(out) or not os.path.isdir(out.parent):
        what = "is a folder" if os.path.isdir(out) else f"no folder {out.parent}"
        raise InputError(f"{out}: {what}, expected a file in a folder that exists")
    require_outside_maps(out.parent, out)
    if not os.path.exists(out):
        return
    for given in [Path(each) for each in inputs if each is not None]:
        if given.exists() and out.samefile(given):
            raise UsageError(f"{out}: is an input of this command, expected another name for its output")
        if given.is_dir() and out.resolve().is_relative_to(given.resolve()):
            raise UsageError(
                f"{out}: is a file in the input {given}, expected a new name, or to remove the file before"
            )


def check_pose_file(out: Path, inputs: Iterable[Path | str | None]) -> None:
    """Check a file of poses as ``check_output`` does. Raises ``UsageError`` where its name has no known ending."""
    from bidnerf_core.results.pose_files import pose_format  # here, since 'report' can do without torch

    pose_format(out)
    check_output(out, inputs)


def check_plot(plot: Path, inputs: Iterable[Path | str | None]) -> None:
    """Check the file of a plot as ``check_output`` does. Raises ``UsageError`` for a name that ends otherwise than plots do."""
    if plot.suffix.lower() not in PLOTS:
        raise UsageError(f"{plot}: expected a name that ends with {' or '.join(PLOTS)}")
    check_output(plot, inputs)


def check_folder(out: Path, inputs: Iterable[Path | str | None], may_be_map: bool = False) -> None:
    """Raise ``UsageError`` where a folder of outputs lies in that of a map, is one of the inputs, or is a map."""
    require_outside_maps(out.parent, out)
    if not may_be_map:
        require_outside_maps(out, out)
    for given in [Path(each) for each in inputs if each is not None]:
        if out.exists() and given.exists() and out.samefile(given):
            raise UsageError(f"{out}: is an input of this command, expected another folder for its output")


def require_outside_maps(folder: Path, out: Path) -> None:
    """Raise ``UsageError`` if ``folder``, which would hold the output ``out``, is that of a map."""
    from bidnerf_core.maps.description import DESCRIPTION

    if (folder / DESCRIPTION).exists():
        raise UsageError(f"{out}: lies in the folder of a map, expected a name outside of it")


def make_folder(folder: Path, inputs: Iterable[Path | str | None]) -> None:
    """Make a folder that pictures are written into.

    Raises ``UsageError`` for a map and for one of the inputs, and ``InputError`` where it cannot be made.
    """
    check_folder(folder, inputs)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: {error.strerror}, expected a folder that can be made") from error
