"""Folders that commands write into."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

from bidnerf_core.errors import InputError
from bidnerf_core.io.files import FileInUse, is_temporary, locked, temporary


@contextlib.contextmanager
def output_folder(out: Path, overwrite: bool) -> Iterator[None]:
    """Create a folder, and check before hours of work that it can be written and that no other process writes into it.

    A folder that is not empty is rejected unless ``overwrite`` is set. If the work fails before anything is in the folder, the
    folder is removed again, with the parents that were created for it. Raises ``InputError``.
    """
    _check_free(out, overwrite)
    made = [folder for folder in (out, *out.parents) if not folder.exists()]
    try:
        _make_writable(out)
        with locked(out):
            _check_free(out, overwrite)  # another process may have finished meanwhile
            yield
    except FileInUse:  # the folder belongs to the other process
        raise
    except BaseException:
        with contextlib.suppress(OSError):  # not empty, or never made
            for folder in made:
                folder.rmdir()
        raise


def _check_free(out: Path, overwrite: bool) -> None:
    if out.exists() and not out.is_dir():
        raise InputError(f"{out}: is a file, expected the name of a folder")
    if out.is_dir() and not overwrite and not all(map(_is_leftover, out.iterdir())):
        from bidnerf_core.cli.opened_map import unfinished

        what = unfinished(out) or "exists already and is not empty"
        raise InputError(f"{out}: {what}; name another --out or pass --overwrite")


def _is_leftover(file: Path) -> bool:
    """Return whether the file was left behind by a process that was killed before the map was complete."""
    from bidnerf_core.maps.description import DESCRIPTION
    from bidnerf_core.maps.files import OURS

    of_map = OURS.fullmatch(file.name) is not None and not (file.parent / DESCRIPTION).exists()
    return of_map or is_temporary(file.name)


def _make_writable(out: Path) -> None:
    try:
        out.mkdir(parents=True, exist_ok=True)
        probe = temporary(out / "writable")
        probe.write_bytes(b"")
        probe.unlink()
    except OSError as error:
        raise InputError(
            f"{out}: cannot be written ({error.strerror}), expected a folder that can be made and written"
        ) from error


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
