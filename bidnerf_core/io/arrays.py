"""Arrays in NumPy files, whose size is checked before memory is allocated for them."""

from __future__ import annotations

import io
import math
import os
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import BinaryIO

import numpy as np

from bidnerf_core.errors import InputError
from bidnerf_core.io.files import open_binary

LARGEST_ARRAY = 800_000_000
"""Bytes: an image of 100 megapixels in double precision."""
HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}


def read_array(path: Path, expected: str) -> np.ndarray:
    """Read the array of a ``.npy`` file. Raises ``InputError`` for anything else, including pickled objects.

    ``expected`` describes in a few words what the file should be.
    """
    with open_binary(path, expected) as file:
        try:
            return _array(file, os.fstat(file.fileno()).st_size)
        except Exception as error:  # NumPy parses the header as Python, which may raise anything
            raise _unreadable(path, error, expected) from error


def read_archive(path: Path, names: Sequence[str], expected: str) -> dict[str, np.ndarray]:
    """Read those of the arrays ``names`` that a ``.npz`` file holds. Raises ``InputError`` as ``read_array`` does."""
    with open_binary(path, expected) as file:
        try:
            with zipfile.ZipFile(file) as archive:
                held = {name: f"{name}.npy" for name in names if f"{name}.npy" in archive.namelist()}
                return {name: _member(archive, member) for name, member in held.items()}
        except Exception as error:  # as above; zipfile has errors of its own as well
            raise _unreadable(path, error, expected) from error


def _member(archive: zipfile.ZipFile, name: str) -> np.ndarray:
    size = archive.getinfo(name).file_size
    if size > LARGEST_ARRAY:
        raise ValueError(f"{name} has {size / 2**20:,.0f} MiB")
    return _array(io.BytesIO(archive.read(name)), size)


def _array(file: BinaryIO | io.BytesIO, size: int) -> np.ndarray:
    """Read an array from a file of ``size`` bytes. Raises ``ValueError``, and NumPy's ``OSError``."""
    version = np.lib.format.read_magic(file)
    if version not in HEADERS:
        raise ValueError(f"version {version} of the format")
    shape, _, kind = HEADERS[version](file)
    if kind.hasobject:
        raise ValueError("objects of Python")
    needed, left = math.prod(shape) * kind.itemsize, size - file.tell()
    if min(shape, default=0) < 0 or needed > min(left, LARGEST_ARRAY):
        raise ValueError(f"an array of {needed:,} bytes in {left:,}".replace(",", " "))
    file.seek(0)
    return np.asarray(np.load(file, allow_pickle=False))


def _unreadable(path: Path, error: Exception, expected: str) -> InputError:
    reason = str(error).strip().partition("\n")[0][:120] or type(error).__name__
    return InputError(f"{path}: not readable as an array ({reason}), expected {expected}")
