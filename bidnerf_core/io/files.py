"""Files and folders named by the user: opening, atomic writing and locking; also the memory and cores available to this process."""

from __future__ import annotations

import contextlib
import io
import os
import re
import secrets
import stat
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from filelock import lock_descriptor

from bidnerf_core.errors import InputError

LARGEST_TEXT = 128 * 2**20
"""Default limit on the size of a file (bytes). Parsed text takes ten times as much memory as its file, so the size is checked
before reading."""
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".ppm", ".pgm")
HEIF_SUFFIXES = (".heic", ".heif", ".hif")


@dataclass(frozen=True)
class PackedFile:
    """A file inside another one, such as a member of a zip archive."""

    where: str  # the archive and the name in it, for messages
    read: Callable[[], bytes]  # returns its content, or raises ``InputError``

    def __str__(self) -> str:
        return self.where


def require_existing(*paths: Path | str | None, expected: str = "the name of one that exists") -> None:
    """Raise ``InputError`` if a file or a folder does not exist; ``expected`` says what it should be. None is left out."""
    for path in paths:
        if path is not None and not os.path.exists(path):
            raise InputError("no such file or folder", where=path, expected=expected)


def open_binary(path: Path | PackedFile, expected: str) -> BinaryIO:
    """Open a regular file for reading. ``expected`` briefly describes what the file should be ("an image file").

    Raises ``InputError`` if there is no such file, if reading is not permitted, for a Git LFS pointer, and for
    folders, pipes, devices and what the kernel shows below /proc: reading from a pipe or from /proc/kmsg could block forever.
    """
    if isinstance(path, PackedFile):
        return io.BytesIO(path.read())
    try:
        facts = path.stat()
        is_shown_by_kernel = os.path.isdir("/proc") and facts.st_dev == os.stat("/proc").st_dev
        file = path.open("rb") if stat.S_ISREG(facts.st_mode) and not is_shown_by_kernel else None
        # The beginning of a file that stands for another one in a repository cloned without Git LFS.
        pointer = b"version https://git-lfs.github.com/spec/"
        is_pointer = file is not None and file.peek(len(pointer)).startswith(pointer)
    except FileNotFoundError as error:
        raise InputError("no such file", where=path, expected=expected) from error
    except PermissionError as error:
        raise InputError("permission denied", where=path, expected=f"a readable file: {expected}") from error
    except (OSError, ValueError) as error:  # a NUL in the name raises ValueError
        raise InputError(
            f"cannot be opened ({getattr(error, 'strerror', None) or error})", where=path, expected=expected
        ) from error
    if file is None:
        kinds = {stat.S_IFDIR: "a folder", stat.S_IFIFO: "a named pipe", stat.S_IFCHR: "a device"}
        raise InputError(
            f"is {kinds.get(stat.S_IFMT(facts.st_mode), 'no regular file')}", where=path, expected=expected
        )
    if is_pointer:
        file.close()
        raise InputError("is a pointer of Git LFS, not the file", where=path, expected="git lfs pull")
    return file


def reason(error: Exception) -> str:
    """Return the first line of an error's message, without a number of the system's, or the error's type if the message is empty."""
    return str(getattr(error, "strerror", None) or error).strip().partition("\n")[0][:120] or type(error).__name__


@contextlib.contextmanager
def library_errors(where: object, found: str, expected: str, *kinds: type[Exception]) -> Iterator[None]:
    """Raise an ``InputError`` for an exception of a library in the block: ``found``, and the library's reason in parentheses.

    ``kinds`` are the library's exceptions. An ``InputError`` of the block stays as it is.
    """
    try:
        yield
    except InputError:
        raise
    except kinds as error:
        raise InputError(f"{found} ({reason(error)})", where=where, expected=expected) from error


def read_file(path: Path, expected: str, most: int = LARGEST_TEXT) -> bytes:
    """Return the content of a regular file. Raises ``InputError`` as ``open_binary`` does, and if the file exceeds ``most`` bytes."""
    with open_binary(path, expected) as file:
        return read_open_file(file, path, expected, most)


def read_open_file(file: BinaryIO, path: Path, expected: str, most: int = LARGEST_TEXT) -> bytes:
    """Read the rest of the open file ``path``. Raises ``InputError`` if the rest is unreadable or exceeds ``most`` bytes."""
    size = os.fstat(file.fileno()).st_size
    if size > most:
        found, limit = (f"{count / 2**20:,.0f} MiB" for count in (size, most))
        raise InputError(f"has {found}", where=path, expected=f"{expected} of at most {limit}")
    with library_errors(path, "cannot be read", expected, OSError):
        return file.read()


def is_file(path: Path) -> bool:
    """Return whether a path that was read from a file exists as a file; False for names that the system rejects."""
    return os.path.isfile(path)


def temporary_name(path: Path) -> Path:
    """Return a new name next to ``path`` that ``is_temporary`` recognizes."""
    return path.with_name(f".{path.name}.{secrets.token_hex(4)}")


def is_temporary(name: str) -> bool:
    """Return whether ``name`` was made by ``temporary_name``; such a file remains if its process is killed while writing."""
    return re.fullmatch(r"\..+\.[0-9a-f]{8}", name) is not None


def write_file(path: Path, content: bytes) -> None:
    """Write a file atomically: it appears under its name only once its whole content is on disk.

    Raises ``OSError``, which names the file, if writing fails; an existing file of that name is then left untouched.
    """
    beside = temporary_name(path)
    try:
        with beside.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        beside.replace(path)
    except BaseException as error:
        with contextlib.suppress(OSError):
            beside.unlink()
        if isinstance(error, OSError):
            raise OSError(error.errno, error.strerror or str(error), str(path)) from error
        raise
    with contextlib.suppress(OSError):  # not all systems can flush a folder's entries to disk
        number = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(number)
        finally:
            os.close(number)


class FileInUse(InputError):
    """Raised if another process is writing to the file or folder."""


@contextlib.contextmanager
def lock(path: Path) -> Iterator[None]:
    """Hold the lock of an existing file or folder within the context.

    Raises ``FileInUse`` if another process holds the lock, or held it and removed the file or folder.
    """
    taken = False
    with contextlib.ExitStack() as opened:
        with contextlib.suppress(FileNotFoundError):  # the process that held the lock removed the folder
            number = os.open(path, os.O_RDONLY)
            opened.callback(os.close, number)
            taken = take_lock(number) and os.path.samestat(os.fstat(number), path.stat())
        if not taken:
            raise FileInUse(
                "another bidnerf process is writing here; name another place, or wait until it ends", where=path
            )
        yield


def take_lock(number: int) -> bool:
    """Lock the file or folder of an open descriptor until it is closed; return False if another process holds the lock.

    The system releases the lock even if the process is killed. On file systems without locks, nothing is locked and the result
    is True.
    """
    try:
        return lock_descriptor(number, blocking=False)
    except OSError:
        return True


def available_memory() -> int:
    """Return the available memory in bytes: that of the machine, or what is left of the container's limit if that is less."""
    import psutil  # imported here, since few commands need it

    available: int = psutil.virtual_memory().available
    with contextlib.suppress(OSError, ValueError):  # no container, or one without a limit
        limit, used = (int(Path("/sys/fs/cgroup", name).read_text()) for name in ("memory.max", "memory.current"))
        available = min(available, max(0, limit - used))
    return available


def usable_cores() -> int:
    """Return the number of cores that this process may use."""
    return (len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()) or 1


@contextlib.contextmanager
def output_folder(
    out: Path,
    overwrite: bool,
    is_leftover: Callable[[Path], bool] = lambda file: False,
    described: Callable[[Path], str | None] = lambda folder: None,
) -> Iterator[None]:
    """Create a folder for results and hold its lock within the context, after checking that it is writable.

    Both are checked before hours of work. A folder that is not empty is rejected unless ``overwrite`` is set; temporary files, and those that
    ``is_leftover`` recognizes, do not count. ``described`` returns a description of a folder's content, for the message. If
    the work fails before anything is in the folder, the folder is removed again, with the parents that were
    created for it. Raises ``InputError`` if a check fails.
    """

    def check() -> None:
        if out.exists() and not out.is_dir():
            raise InputError("is a file", where=out, expected="the name of a folder")
        files = out.iterdir() if out.is_dir() and not overwrite else ()
        if not all(is_temporary(file.name) or is_leftover(file) for file in files):
            raise InputError(
                f"{described(out) or 'exists already and is not empty'}; name another folder, or overwrite it"
                " (`overwrite`)",
                where=out,
            )

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
    expected = "a folder that can be created and written"
    with library_errors(out, "cannot be written", expected, OSError), removed_on_failure():
        out.mkdir(parents=True, exist_ok=True)
        probe = temporary_name(out / "writable")
        probe.write_bytes(b"")
        probe.unlink()
    # The folder is removed while the lock is held: afterwards, it may belong to another process.
    with lock(out), removed_on_failure():
        check()  # another process may have finished meanwhile
        yield
