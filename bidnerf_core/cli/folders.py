"""Files and folders that commands write: they are checked before any work, and never replace an input."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterable
from pathlib import Path

from bidnerf_core.errors import InputError, UsageError

PLOTS = ".png", ".svg"
"""The file extensions of plots."""


def check_output(out: Path, inputs: Iterable[Path | str | None]) -> None:
    """Raise, before any work is done, if the file ``out`` cannot be written or would replace an input.

    Inputs are the files of any map, the ``inputs``, and files in folders among them. Raises ``UsageError``
    for these, and ``InputError`` for a folder, and for a name in a folder that does not exist.
    """
    # os.path functions return False for a name that is too long, which is reported when it is written.
    if os.path.isdir(out) or not os.path.isdir(out.parent):
        what = "is a folder" if os.path.isdir(out) else f"no folder {out.parent}"
        raise InputError(what, where=out, expected="a file in an existing folder")
    require_outside_maps(out.parent, out)
    require_writable(out.parent, out)
    if not os.path.exists(out):
        return
    for given in [Path(each) for each in inputs if each is not None]:
        if given.exists() and out.samefile(given):
            raise UsageError("is an input of this command", where=out, expected="another name for its output")
        if given.is_dir() and out.resolve().is_relative_to(given.resolve()):
            raise UsageError(
                f"is a file in the input {given};", where=out, expected="a new name, or remove the file first"
            )


def check_pose_file(out: Path, inputs: Iterable[Path | str | None]) -> None:
    """Check an output file of poses as ``check_output`` does. Raises ``UsageError`` for an unknown file extension."""
    from bidnerf_core.results import pose_format  # imported here, since 'report' works without torch

    pose_format(out)
    check_output(out, inputs)


def check_plot(plot: Path, inputs: Iterable[Path | str | None]) -> None:
    """Check the file of a plot as ``check_output`` does. Raises ``UsageError`` for a file extension that is
    not a plot's.
    """
    if plot.suffix.lower() not in PLOTS:
        raise UsageError(where=plot, expected=f"a name that ends with {' or '.join(PLOTS)}")
    check_output(plot, inputs)


def check_folder(out: Path, inputs: Iterable[Path | str | None], may_be_map: bool = False) -> None:
    """Raise ``UsageError`` if an output folder lies inside a map, is one of the inputs, or is a map."""
    require_outside_maps(out.parent, out)
    if not may_be_map:
        require_outside_maps(out, out)
    for given in [Path(each) for each in inputs if each is not None]:
        if out.exists() and given.exists() and out.samefile(given):
            raise UsageError(
                "is an input of this command", where=out, expected="another folder for its output"
            )


def require_writable(folder: Path, out: Path) -> None:
    """Raise ``InputError`` if no file can be created in ``folder``, which is to hold the output ``out``."""
    try:
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        reason = f"cannot be written: {error.strerror}"
        raise InputError(reason, where=out, expected="a folder in which files can be created") from error


def require_outside_maps(folder: Path, out: Path) -> None:
    """Raise ``UsageError`` if ``folder``, which would hold the output ``out``, is a map."""
    from bidnerf_core.maps import DESCRIPTION

    if (folder / DESCRIPTION).exists():
        raise UsageError("lies in the folder of a map", where=out, expected="a name outside of it")


def make_folder(folder: Path, inputs: Iterable[Path | str | None]) -> None:
    """Create a folder for pictures.

    Raises ``UsageError`` if it is a map or one of the inputs, and ``InputError`` if it cannot be created.
    """
    check_folder(folder, inputs)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(error.strerror, where=folder, expected="a folder that can be created") from error
    require_writable(folder, folder)
