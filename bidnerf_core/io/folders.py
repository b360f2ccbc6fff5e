"""Output folders."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path

from bidnerf_core.errors import InputError
from bidnerf_core.io.files import is_temporary, locked, temporary


@contextlib.contextmanager
def output_folder(
    out: Path,
    overwrite: bool,
    is_leftover: Callable[[Path], bool] = lambda file: False,
    described: Callable[[Path], str | None] = lambda folder: None,
) -> Iterator[None]:
    """Create a folder, and check before hours of work that it is writable and that no other process writes to it.

    A folder that is not empty is rejected unless ``overwrite`` is set; temporary files, and those that
    ``is_leftover`` recognizes, do not count. ``described`` returns what a folder holds, for the message. If
    the work fails before anything is in the folder, the folder is removed again, with the parents that were
    created for it. Raises ``InputError``.
    """

    def check() -> None:
        if out.exists() and not out.is_dir():
            raise InputError("is a file", where=out, expected="the name of a folder")
        files = out.iterdir() if out.is_dir() and not overwrite else ()
        if not all(is_temporary(file.name) or is_leftover(file) for file in files):
            what = described(out) or "exists already and is not empty"
            raise InputError(f"{what}; name another folder, or overwrite it (--overwrite)", where=out)

    @contextlib.contextmanager
    def removed_on_failure() -> Iterator[None]:
        try:
            yield
        except BaseException:
            with contextlib.suppress(OSError):  # not empty, or never created
                for folder in made:
                    folder.rmdir()
            raise

    check()
    made = [folder for folder in (out, *out.parents) if not folder.exists()]
    try:
        with removed_on_failure():
            out.mkdir(parents=True, exist_ok=True)
            probe = temporary(out / "writable")
            probe.write_bytes(b"")
            probe.unlink()
    except OSError as error:
        found, expected = f"cannot be written ({error.strerror})", "a folder that can be created and written"
        raise InputError(found, where=out, expected=expected) from error
    # While the lock is held: afterwards, the folder may be another process's.
    with locked(out), removed_on_failure():
        check()  # another process may have finished meanwhile
        yield
