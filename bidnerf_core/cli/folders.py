"""Checks of the places that commands write to."""

from __future__ import annotations

from pathlib import Path

from bidnerf_core.errors import InputError


def check_pose_file(out: Path) -> None:
    """Raise, before any work is done, where a file of poses cannot be written."""
    from bidnerf_core.results.pose_files import (
        pose_format,
    )  # here, since it imports torch, which 'report' can do without

    pose_format(out)
    if out.is_dir() or not out.parent.is_dir():
        what = "is a folder" if out.is_dir() else f"no folder {out.parent}"
        raise InputError(f"{out}: {what}, expected a file in a folder that exists")


def make_folder(folder: Path) -> None:
    """Make a folder that pictures are written into. Raises ``InputError`` where that is not possible."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: {error.strerror}, expected a folder that can be made") from error
