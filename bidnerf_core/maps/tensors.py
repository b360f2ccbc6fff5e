"""Files of named tensors: reading them, and checking them against their intended use."""

from __future__ import annotations

import json
import os
import struct
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO, TypeVar, cast

from safetensors import SafetensorError
from safetensors.torch import load as tensors_from_bytes
from torch import Tensor, nn

from bidnerf_core.backend import UpgradingField
from bidnerf_core.errors import InputError
from bidnerf_core.fields.contract import RadianceField
from bidnerf_core.io.files import open_binary

Part = TypeVar("Part")
EXPECTED_FILE = "a safetensors file"
LARGEST_HEADER = 16 * 2**20
"""Bytes; the header takes about a hundred for each tensor."""


def read_tensors(path: Path) -> dict[str, Tensor]:
    """Return the tensors of a file. Raises ``InputError`` if it is not such a file, or if its length contradicts its header."""
    if not os.path.lexists(path):
        raise InputError(f"{path}: no such file, but map.json names it; the map is incomplete")
    try:
        with open_binary(path, EXPECTED_FILE) as file:
            _check_length(path, file)
            return tensors_from_bytes(file.read())
    except (SafetensorError, KeyError, ValueError, RuntimeError, OverflowError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: not readable ({error}), expected {EXPECTED_FILE}") from error


def _check_length(path: Path, file: BinaryIO) -> None:
    """Compare the length of a file with its header, before memory is allocated for the tensors."""
    size = os.fstat(file.fileno()).st_size
    length = struct.unpack("<Q", file.read(8).ljust(8, b"\xff"))[0]
    if not length <= min(size - 8, LARGEST_HEADER):
        raise InputError(f"{path}: not readable (its header is cut off), expected {EXPECTED_FILE}")
    try:
        header = json.loads(file.read(length))
        ends = [part["data_offsets"][1] for name, part in header.items() if name != "__metadata__"]
        described = 8 + length + max(ends, default=0)
    except (ValueError, TypeError, KeyError, IndexError, AttributeError, RecursionError) as error:
        raise InputError(f"{path}: not readable (its header is damaged), expected {EXPECTED_FILE}") from error
    if described != size:
        raise InputError(
            f"{path}: has {size} bytes, its header describes {described}; expected {EXPECTED_FILE}"
        )
    file.seek(0)


def load_part(path: Path, make: Callable[[dict[str, Tensor]], Part], what: str) -> Part:
    """Return what ``make`` returns for the tensors of a file. Raises ``InputError`` where it rejects them."""
    tensors = read_tensors(path)
    try:
        return make(tensors)
    except (KeyError, ValueError) as error:
        why = f"no tensor {error}" if isinstance(error, KeyError) else str(error)
        raise InputError(f"{path}: not {what} ({why}); bake it anew with 'bidnerf bake'") from error


def checked_weights(field: RadianceField, tensors: dict[str, Tensor], path: Path) -> dict[str, Tensor]:
    """Return a field's tensors from a file, upgraded where an earlier version stored them, after checking them.

    Their names, shapes and values are checked against the field here, since torch's own message would take many lines.
    """
    if isinstance(field, UpgradingField):
        tensors = field.upgraded_state(tensors)
    module = cast(nn.Module, field)
    expected = module.state_dict()
    for name, value in expected.items():
        if name not in tensors:
            raise InputError(f"{path}: no tensor {name!r}, expected one of shape {list(value.shape)}")
        if tensors[name].shape != value.shape:
            found, wanted = list(tensors[name].shape), list(value.shape)
            raise InputError(f"{path}: tensor {name!r} has shape {found}, expected {wanted}")
        if tensors[name].is_floating_point() != value.is_floating_point():
            kinds = (str(kind).removeprefix("torch.") for kind in (tensors[name].dtype, value.dtype))
            raise InputError(f"{path}: tensor {name!r} is of {next(kinds)}, expected {next(kinds)}")
    surplus = sorted(tensors.keys() - expected.keys())
    if surplus:
        raise InputError(f"{path}: tensor {surplus[0]!r} is not part of the field that map.json describes")
    for name, _ in module.named_parameters():
        if name in tensors and not bool(tensors[name].isfinite().all()):
            raise InputError(f"{path}: tensor {name!r} holds NaN or infinity, expected finite numbers")
    for name, _ in module.named_buffers():
        if name in tensors and bool(tensors[name].isnan().any()):
            raise InputError(f"{path}: tensor {name!r} holds NaN, expected numbers")
    return tensors


def packed(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """Return contiguous copies on the CPU, as safetensors needs them."""
    return {name: value.detach().cpu().contiguous().clone() for name, value in tensors.items()}
