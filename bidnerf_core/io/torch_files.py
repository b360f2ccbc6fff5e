"""Files written by ``torch.save``, read without running any code in them."""

from __future__ import annotations

import pickle
import re
import zipfile
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.utils._pytree import tree_leaves

from bidnerf_core.errors import InputError
from bidnerf_core.io.archives import Archive
from bidnerf_core.io.files import open_binary


class _Ignored:
    """Placeholder for a NumPy number, which programs store among optimizer settings; its value is discarded."""

    def __init__(self, *parts: object) -> None:
        pass

    def __setstate__(self, state: object) -> None:
        pass


def read_saved(path: Path, expected: str, mapped: bool = False) -> Any:
    """Read a file written by ``torch.save``: tensors and numbers in dicts and lists. NumPy numbers come back as placeholders.

    ``expected`` briefly describes what the file should be. With ``mapped``, tensors stay in the file until they are used, so that
    one of any size is recognised quickly; files in the format of torch before version 1.6, which are not zip archives,
    cannot be mapped and are read. Raises a one-line ``InputError`` if there is no such file, it is damaged, it would
    run code, it unpacks to more than its size or, unless ``mapped``, it holds a tensor that does, such as an expanded one
    (stride 0).
    """
    open_binary(
        path, expected
    ).close()  # errors here concern opening the file; all later ones concern its content
    size = path.stat().st_size
    archive = Archive(path, expected) if zipfile.is_zipfile(path) else None
    if archive is not None and archive.unpacked_size > size:
        found = f"unpacks to {archive.unpacked_size / 2**20:,.0f} MiB"
        raise InputError(
            found, where=path, expected=f"{expected} that is not compressed, as torch.save writes it"
        )
    try:
        arrays = [f"numpy.{core}.multiarray.scalar" for core in ("_core", "core")]
        kinds = [f"numpy.dtypes.Float{bits}DType" for bits in (64, 32)]
        names = [*arrays, *kinds, "numpy.dtype", "_codecs.encode"]
        with torch.serialization.safe_globals([(_Ignored, name) for name in names]):
            content = torch.load(
                path, map_location="cpu", weights_only=True, mmap=mapped and archive is not None
            )
    except Exception as error:  # each kind of damage raises a different exception
        code = re.search(r"GLOBAL ([\w.]+)", str(error))  # how torch names what a file tried to call
        if isinstance(error, pickle.UnpicklingError) and code:
            found = f"would run code ({code[1]}) and was not read"
        else:
            found = f"not written by torch.save, or damaged ({type(error).__name__});"
        raise InputError(found, where=path, expected=expected) from error
    for tensor in () if mapped else tree_leaves(content):  # those that stay in the file take no memory
        if not isinstance(tensor, Tensor):
            continue
        needed = tensor.numel() * tensor.element_size()
        stored = tensor.untyped_storage().nbytes() if tensor.layout is torch.strided else 0
        if needed > min(stored, size):
            found = f"a tensor {tuple(tensor.shape)} needs {needed:,} bytes, but the file has only {size:,};"
            raise InputError(found, where=path, expected=expected)
    return content
