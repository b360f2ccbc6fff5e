"""Files of arrays and tensors (NumPy, safetensors, torch), whose size is checked before memory is allocated."""

from __future__ import annotations

import json
import math
import os
import pickle
import re
import sys
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load as tensors_from_bytes
from torch import Tensor
from torch.utils._pytree import tree_leaves

from bidnerf_core.errors import InputError
from bidnerf_core.io.allowance import Allowance
from bidnerf_core.io.archives import Archive
from bidnerf_core.io.files import PackedFile, library_errors, open_binary

_Part = TypeVar("_Part")

TENSOR_FILE = "a safetensors file"


def read_array(path: Path | PackedFile, expected: str) -> np.ndarray:
    """Read the array of a ``.npy`` file. Raises ``InputError`` for anything else, including pickled objects.

    ``expected`` briefly describes what the file should be.
    """
    # NumPy parses the header as Python, which may raise anything.
    with library_errors(path, "not readable as an array", expected, Exception), open_binary(path, expected) as file:
        array: np.ndarray = np.lib.format.read_array(file, allow_pickle=False)
        return array


def read_tensors(path: Path, expected: str = TENSOR_FILE) -> dict[str, Tensor]:
    """Read the tensors of a safetensors file. Raises ``InputError`` as ``read_tensors_and_metadata`` does."""
    return read_tensors_and_metadata(path, expected)[0]


def read_tensors_and_metadata(path: Path, expected: str = TENSOR_FILE) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Read the tensors of a safetensors file, and the metadata in its header.

    Raises ``InputError`` if the file is not a safetensors file, or if its length contradicts its header.
    """
    damages = SafetensorError, KeyError, ValueError, RuntimeError, OverflowError, OSError
    with open_binary(path, expected) as file, library_errors(path, "not readable", expected, *damages):
        length = int.from_bytes(file.read(8), "little")  # of the header
        if not 0 < length <= os.fstat(file.fileno()).st_size - 8:
            raise ValueError("its header is truncated")
        file.seek(0)
        content = file.read()
        tensors = tensors_from_bytes(content)  # checks the header against the length of the content
        if max((tensor.dim() for tensor in tensors.values()), default=0) > 64:
            raise ValueError("a tensor has more than 64 axes, on which torch cannot compute")
        return tensors, json.loads(content[8 : 8 + length]).get("__metadata__") or {}


@dataclass(frozen=True)
class TensorKind:
    """The shape, type and range of a tensor in a file; other values would make later computations fail or overflow."""

    shape: str  # such as "n 3"; a letter stands for the same number in all tensors of a file; it is not 0 if capital
    dtype: torch.dtype = torch.float32
    least: float = -math.inf
    most: float = math.inf
    is_unit: bool = False  # whether the vectors along the last axis have length 1
    index_of: str = ""  # if the values are indices: the letter whose number they must stay below


def check_tensors(tensors: Mapping[str, Tensor], kinds: Mapping[str, TensorKind]) -> None:
    """Check tensors against their kinds, in order.

    Raises ``KeyError`` for a missing tensor, and ``ValueError`` for a tensor of another shape, type or range or with NaN or infinity.
    """
    sizes: dict[str, int] = {}
    for name, kind in kinds.items():
        value, axes = tensors[name], kind.shape.split()
        for axis, size in zip(axes, value.shape, strict=False):
            sizes.setdefault(axis, int(axis) if axis.isdecimal() else max(size, int(axis.isupper())))
        expected = [sizes.get(axis, axis) for axis in axes]
        if value.dtype != kind.dtype or list(value.shape) != expected:
            raise ValueError(f"{name} is {value.dtype} {list(value.shape)}, expected {kind.dtype} {expected}")
        if value.is_floating_point() and not bool(value.isfinite().all()):
            raise ValueError(f"{name} holds NaN or infinity")
        least, most = (0, sizes[kind.index_of] - 1) if kind.index_of else (kind.least, kind.most)
        if value.numel() and not least <= float(value.min()) <= float(value.max()) <= most:
            found = " to ".join(f"{end:g}" for end in torch.stack([value.min(), value.max()]).unique().tolist())
            limits = "a positive number" if least == sys.float_info.min else f"{least:g} to {most:g}"
            raise ValueError(f"{name} is {found}, expected {limits}")
        if kind.is_unit and bool(((torch.linalg.vector_norm(value, dim=-1) - 1).abs() > 1e-3).any()):
            raise ValueError(f"{name} are not of unit length")


def load_part(path: Path, make: Callable[[dict[str, Tensor]], _Part], what: str, expected: str = TENSOR_FILE) -> _Part:
    """Return the result of ``make`` for the tensors of a file. Raises ``InputError`` if ``make`` rejects the tensors."""
    tensors = read_tensors(path, expected)
    try:
        return make(tensors)
    except (KeyError, ValueError) as error:
        raise InputError(
            f"not {what} ({'no tensor ' if isinstance(error, KeyError) else ''}{error})", where=path, expected=expected
        ) from error


def pack_tensors(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """Return contiguous copies of ``tensors`` on the CPU, as safetensors requires."""
    return {name: value.detach().cpu().contiguous().clone() for name, value in tensors.items()}


IGNORED = (
    "numpy._core.multiarray.scalar",
    "numpy.core.multiarray.scalar",
    "numpy.dtypes.Float64DType",
    "numpy.dtypes.Float32DType",
    "numpy.dtype",
    "_codecs.encode",
)
"""What a saved NumPy number calls; in its place, ``_Ignored`` is made."""


class _Ignored:
    """Placeholder for a NumPy number, which programs store among optimizer settings; its value is discarded."""

    def __init__(self, *parts: object) -> None:
        pass

    def __setstate__(self, state: object) -> None:
        pass


def read_saved(path: Path, expected: str, mapped: bool = False) -> Any:
    """Read a file written by ``torch.save``: tensors and numbers in dicts and lists. NumPy numbers come back as placeholders.

    ``expected`` briefly describes what the file should be. With ``mapped``, tensors stay in the file until they are used, so that
    a file of any size is recognised quickly; files in the format of torch before version 1.6, which are not zip archives,
    cannot be mapped and are read. Raises a one-line ``InputError`` if the file is missing or damaged, would run code, or unpacks to
    more than its own size, or if its tensors, which may share numbers, take too much memory (see ``Allowance``; not if ``mapped``).
    """
    open_binary(path, expected).close()  # errors here concern opening the file; all later ones concern its content
    archive = Archive(path, expected) if zipfile.is_zipfile(path) else None
    if archive is not None and archive.unpacked_size > path.stat().st_size:
        raise InputError(
            f"unpacks to {archive.unpacked_size / 2**20:,.0f} MiB",
            where=path,
            expected=f"{expected} that is not compressed, as torch.save writes it",
        )
    try:
        with torch.serialization.safe_globals([(_Ignored, name) for name in IGNORED]):
            content = torch.load(path, map_location="cpu", weights_only=True, mmap=mapped and archive is not None)
    except Exception as error:  # each kind of damage raises a different exception
        code = re.search(r"GLOBAL ([\w.]+)", str(error))  # how torch names what a file tried to call
        raise InputError(
            f"would run code ({code[1]}) and was not read"
            if isinstance(error, pickle.UnpicklingError) and code
            else f"not written by torch.save, or damaged ({type(error).__name__});",
            where=path,
            expected=expected,
        ) from error
    allowance = Allowance.of(path, expected)
    with library_errors(path, "contains itself, or too many parts within each other", expected, RecursionError):
        for leaf in tree_leaves(content):
            if isinstance(leaf, Tensor) and not mapped:  # those that stay in the file take no memory
                allowance.take(leaf.numel() * leaf.element_size())
    return content
