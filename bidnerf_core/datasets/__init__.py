"""Readers of posed images, and a writer. All conventions of file formats are converted here."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Protocol, runtime_checkable

from bidnerf_core.datasets.dataset import Dataset, ReadingProgress
from bidnerf_core.datasets.scanner_app import ScannerAppReader
from bidnerf_core.datasets.transforms import TransformsReader
from bidnerf_core.datasets.writing import write_transforms
from bidnerf_core.errors import InputError
from bidnerf_core.images import Background

__all__ = [
    "READERS",
    "Background",
    "Dataset",
    "Reader",
    "ReadingProgress",
    "open_dataset",
    "write_transforms",
]


@runtime_checkable
class Reader(Protocol):
    """A reader of one dataset format.

    ``expected`` names the files that its folders hold, for error messages. ``recognises`` returns whether a folder has its
    format. ``open`` returns the dataset and raises ``InputError`` if the folder cannot be used.
    """

    @property
    def expected(self) -> str: ...

    def recognises(self, path: Path) -> bool: ...

    def open(self, path: Path, background: Background | None) -> Dataset: ...


READERS: list[Reader] = [TransformsReader(), ScannerAppReader()]
"""The formats that ``open_dataset`` tries, in this order; append a reader to add one."""


def open_dataset(
    path: str | Path, background: Background | None = None, readers: Sequence[Reader] | None = None
) -> Dataset:
    """Open the dataset in the folder ``path``. Descriptions are read and checked now, images when views are requested.

    ``background`` ("white", "black" or an rgb triple in [0, 1]) lies behind images with an alpha channel. The default is
    white where the images have one, as is the convention of NeRF-Synthetic, and black otherwise. Raises ``InputError``
    where there is no such folder, where no reader recognises it, and where a description is not usable.
    """
    folder = Path(path)
    if not folder.exists():
        raise InputError(f"{folder}: no such folder")
    if not folder.is_dir():
        raise InputError(f"{folder}: is a file, expected the folder of a dataset")
    readers = READERS if readers is None else readers
    for reader in readers:
        if reader.recognises(folder):
            return reader.open(folder, background)
    raise InputError(
        f"{folder}: no dataset found, expected {' or '.join(reader.expected for reader in readers)}"
    )
