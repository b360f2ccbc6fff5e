"""Torch devices and threads: where tensors reside, when the host may wait for them, and how many threads
compute.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import fields, is_dataclass
from functools import lru_cache
from threading import Lock
from typing import Any, TypeVar

import torch
from jaxtyping import Shaped
from torch import Tensor, nn

from bidnerf_core.errors import InputError

T = TypeVar("T")


# Constants as tensors. Each is created once per device, since creating one copies it there from the host.

_notes: list[list[Tensor]] = []


def constant(values: tuple[float, ...], like: Tensor) -> Shaped[Tensor, "n"]:
    """Return ``values`` with the dtype and device of ``like``. The result is shared: do not modify it."""
    found = _constant(values, like.dtype, like.device)
    for notes in _notes:
        notes.append(found)
    return found


@contextmanager
def noted() -> Iterator[list[Tensor]]:
    """Collect all constants that are requested within the context, in any thread; the list keeps them alive."""
    notes: list[Tensor] = []
    _notes.append(notes)
    try:
        yield notes
    finally:
        _notes.remove(notes)


@lru_cache(maxsize=256)
def _constant(values: tuple[float, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    with torch.inference_mode(False):
        return torch.tensor(values, dtype=dtype).to(device)


def forget() -> None:
    """Discard all constants, for instance when a device no longer exists."""
    _constant.cache_clear()


# Whether code may make the host wait for the device. On a GPU, each number that the host reads from a tensor,
# and each size that depends on values, blocks the host until the device has finished all queued work.
# Skipping needless computation is worth that wait in training and when whole images are rendered, but not in
# the short steps of a localization: there, code computes more than it needs, in known shapes.

_allowed: ContextVar[bool] = ContextVar("waiting_allowed", default=True)


@contextmanager
def without_waiting() -> Iterator[None]:
    """Make ``may_wait`` return False for all devices but the CPU, in this thread."""
    token = _allowed.set(False)
    try:
        yield
    finally:
        _allowed.reset(token)


def may_wait(device: torch.device) -> bool:
    """Return whether code may read values from tensors on ``device``; always True on the CPU, where nothing
    is queued.
    """
    return device.type == "cpu" or _allowed.get()


# Moving objects that hold tensors to a device.


def working_device(device: torch.device | str) -> torch.device:
    """Return a device after a test computation on it; a valid name does not mean that the device works on
    this machine.

    Raises ``InputError`` if it does not work.
    """
    try:
        found = torch.device(device)
        if found.type == "cpu" and found.index:  # torch ignores the number
            raise RuntimeError("there is only one CPU")
        torch.ones((), device=found).item()
    except (RuntimeError, AssertionError, TypeError) as error:  # depends on the build of torch
        raise InputError(
            f"device {str(device)!r} does not work here", expected="a working device such as cpu"
        ) from error
    return found


def moved(value: T, device: torch.device | str) -> T:
    """Return ``value`` with every tensor in it on ``device``; ``value`` itself is not modified.

    Tensors are found in modules, in the fields of dataclasses, and in lists, tuples and dictionaries of
    these. Anything else stays the same object, as does ``value`` itself if it is already on ``device``.
    Values cached by a dataclass are recomputed on the device.
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
        parts = {part.name: vars(value)[part.name] for part in fields(value) if part.name in vars(value)}
        there = _moved(parts, device)
        if there is parts:
            return value
        found = object.__new__(type(value))
        vars(found).update(there)  # also the fields that its constructor does not take
        return found
    if isinstance(value, dict):
        content = {key: _moved(part, device) for key, part in value.items()}
        return content if any(content[key] is not value[key] for key in value) else value
    if type(value) in (list, tuple):
        items = [_moved(part, device) for part in value]
        same = all(new is old for new, old in zip(items, value, strict=True))
        return value if same else type(value)(items)
    return value


def _is_on(tensor: Tensor, device: torch.device) -> bool:
    """Return whether a tensor is on ``device``; a device without an index matches any device of its type."""
    here = tensor.device
    return here.type == device.type and device.index in (None, here.index)


# Threads of torch's operators on a CPU.

_setting = Lock()


@contextmanager
def one_thread() -> Iterator[int]:
    """Run torch operators called from this Python thread on one thread within the block; yields the usual
    number.

    Sums are then the same on any machine. Other Python threads are not affected, and may be in such blocks
    too.
    """
    usual = torch.get_num_threads()
    set_threads_here(1)
    try:
        yield usual
    finally:
        set_threads_here(usual)


def set_threads_here(count: int) -> None:
    """Set how many threads torch's operators use when called from this Python thread only.

    ``torch.set_num_threads`` also sets the number for Python threads that start later, so that number is
    restored.
    """
    with _setting:
        torch.get_num_threads()  # on first use, a thread takes the default, which would override a value set before
        default = _in_new_thread(torch.get_num_threads)
        torch.set_num_threads(count)
        _in_new_thread(lambda: torch.set_num_threads(default))


def _in_new_thread(function: Callable[[], T]) -> T:
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(function).result()
