"""Readers of posed images from disk, and a writer. All conversions of convention happen in here, once."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Protocol, runtime_checkable

from bidnerf_core.datasets.dataset import Dataset, ReadingProgress
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
    """One format. ``expected`` says in a few words what its folders hold."""

    @property
    def expected(self) -> str: ...

    def recognises(self, path: Path) -> bool: ...

    def open(self, path: Path, background: Background | None) -> Dataset: ...


READERS: list[Reader] = [TransformsReader()]
"""Asked in this order; append to it to have ``open_dataset`` know another format."""


def open_dataset(
    path: str | Path, background: Background | None = None, readers: Sequence[Reader] | None = None
) -> Dataset:
    """Open the dataset in the folder ``path``: descriptions are read and judged now, images when they are asked for.

    ``background`` is "white", "black" or an rgb triple in [0, 1] that images with an alpha channel are laid over. Default:
    white where the images have one (the convention of NeRF-Synthetic), else black. Raises ``InputError`` where there is
    no such folder, where no reader recognises it, and where a description is not usable.
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
