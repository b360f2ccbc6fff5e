"""Moving objects that hold tensors to a device."""

from __future__ import annotations

import copy
from dataclasses import fields, is_dataclass
from typing import Any, TypeVar

import torch
from torch import Tensor, nn

from bidnerf_core.errors import InputError

_T = TypeVar("_T")


def working_device(device: torch.device | str) -> torch.device:
    """Return a device after a test computation on it: its name alone does not show whether it works on this machine.

    Raises ``InputError`` for one that does not work.
    """
    try:
        found = torch.device(device)
        torch.ones((), device=found).item()
    except (RuntimeError, AssertionError, TypeError) as error:  # which one depends on the build of torch
        raise InputError(
            f"device {str(device)!r} does not work here, expected one that does, such as cpu"
        ) from error
    return found


def moved(value: _T, device: torch.device | str) -> _T:
    """Return ``value`` with every tensor in it on ``device``; ``value`` itself is left as it is.

    Tensors are found in modules, in the fields of dataclasses, and in lists, tuples and dictionaries of these; anything else
    stays the same object, and so does ``value`` as a whole if it is on ``device`` already. Values that a dataclass has cached
    are computed anew on the device.
    """
    found: Any = _moved(value, torch.device(device))
    return found


def _moved(value: Any, device: torch.device) -> Any:
    if isinstance(value, nn.Module):
        tensors = (*value.parameters(), *value.buffers())
        return value if all(_is_on(t, device) for t in tensors) else copy.deepcopy(value).to(device)
    if isinstance(value, Tensor):
        return value if _is_on(value, device) else value.to(device)
    if is_dataclass(value) and not isinstance(value, type):
        parts = {part.name: getattr(value, part.name) for part in fields(value)}
        there = _moved(parts, device)
        return value if there is parts else _with_fields(value, there)
    if isinstance(value, dict):
        content = {key: _moved(part, device) for key, part in value.items()}
        return content if any(content[key] is not value[key] for key in value) else value
    if type(value) in (list, tuple):
        items = [_moved(part, device) for part in value]
        same = all(new is old for new, old in zip(items, value, strict=True))
        return value if same else type(value)(items)
    return value


def _with_fields(value: Any, parts: dict[str, Any]) -> Any:
    """Return a new instance of a dataclass with these fields, including those that its constructor does not take."""
    found = object.__new__(type(value))
    for name, part in parts.items():
        object.__setattr__(found, name, part)
    return found


def _is_on(tensor: Tensor, device: torch.device) -> bool:
    """Return whether a tensor is on ``device``; a device without an index matches any of its type."""
    here = tensor.device
    return here.type == device.type and device.index in (None, here.index)
