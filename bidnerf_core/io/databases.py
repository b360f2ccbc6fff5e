"""Tables of SQLite files and arrays of HDF5 files, read by name.

Both formats are programs as much as data: a table may be a view that computes its rows without end, and an array may lie in
another file or not exist at all. Only stored tables and arrays are read, and no more than the file holds.
"""

from __future__ import annotations

import contextlib
import math
import sqlite3
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from bidnerf_core.errors import InputError
from bidnerf_core.installation import import_extra
from bidnerf_core.io.allowance import Allowance
from bidnerf_core.io.files import library_errors, open_binary

STEP = 10_000
"""Number of SQLite's instructions after which the total is checked. Reading a row takes about ten, and a row at least five bytes."""


def read_database_table(path: Path, table: str, columns: Sequence[str], expected: str) -> Iterator[tuple[Any, ...]]:
    """Yield the rows of a table in a SQLite file, each with the values of ``columns``. Nothing is written beside the file.

    Raises ``InputError`` if the file is damaged or has no such table, for views and virtual tables, and if the rows take more
    than the file can hold. ``expected`` briefly describes the file.
    """
    with open_binary(path, expected) as file:
        size = file.seek(0, 2)
    allowance, steps = Allowance.of(path, expected), iter(range(100 + size // 1000))

    def authorize(action: int, name: str | None, *_: object) -> int:
        """Allow only reading of the table and of the schema: no function, and no table behind a view."""
        reads = action == sqlite3.SQLITE_READ and name in (table, "sqlite_master")
        return sqlite3.SQLITE_OK if reads or action == sqlite3.SQLITE_SELECT else sqlite3.SQLITE_DENY

    address = f"file:{quote(str(path.resolve()))}?mode=ro&immutable=1"
    with (
        library_errors(path, "cannot be read", expected, sqlite3.Error),
        contextlib.closing(sqlite3.connect(address, uri=True)) as opened,
    ):
        opened.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, min(max(size, 1000), 2**31 - 1))  # of a value
        opened.set_authorizer(authorize)
        opened.set_progress_handler(lambda: next(steps, None) is None, STEP)
        for kind, text in opened.execute("SELECT type, sql FROM sqlite_master WHERE name = ?", (table,)):
            if kind != "table" or "virtual" in str(text)[:20].lower():
                raise InputError(f"its {table!r} is a view, not a stored table", where=path, expected=expected)
        for row in opened.execute(f"SELECT {', '.join(columns)} FROM {table}"):
            allowance.take(sum(map(sys.getsizeof, row)))
            yield row


@contextlib.contextmanager
def open_arrays(path: Path, expected: str) -> Iterator[Callable[..., np.ndarray | None]]:
    """Open a HDF5 file; yield a function that returns the array at a path of group names, or None if there is nothing.

    The function raises ``InputError`` for anything but a stored array of numbers: a link, an array in another file, one that
    is compressed or that was never written, and for arrays that together take more than the file can hold. ``expected``
    briefly describes the file.
    """
    open_binary(path, expected).close()
    h5py = import_extra("h5py", "hloc", f"reading {expected}", path)
    allowance = Allowance.of(path, expected)

    def read(*names: str) -> np.ndarray | None:
        where, found = "/".join(names), opened
        for name in names:
            if not isinstance(found, h5py.Group) or (link := found.get(name, getlink=True)) is None:
                return None
            if not isinstance(link, h5py.HardLink):
                raise InputError(f"{where} is a link", where=path, expected="arrays in the file itself")
            found = found[name]
        if not isinstance(found, h5py.Dataset) or found.dtype.kind not in "fiu" or found.shape is None:
            raise InputError(f"{where} is {found!r}"[:120], where=path, expected="an array of numbers")
        layout = found.id.get_create_plist()
        if found.is_virtual or layout.get_external_count() or layout.get_nfilters():
            raise InputError(f"{where} is compressed or in another file", where=path, expected="a plain array")
        # Of an array in chunks, those that were never written would be made up, even one number at a time.
        size = math.prod(found.shape) * found.dtype.itemsize
        if found.id.get_storage_size() < size:
            raise InputError(f"{where} declares {size:,} bytes that are not stored", where=path, expected=expected)
        allowance.take(size)
        return np.asarray(found)

    # The library raises anything, such as RuntimeError for a damaged object.
    with library_errors(path, "cannot be read", expected, Exception), h5py.File(path, "r") as opened:
        yield read
