"""Constants as tensors. Each is made once per device, since making one copies it there from the host."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache

import torch
from jaxtyping import Shaped
from torch import Tensor

_notes: list[list[Tensor]] = []


def constant(values: tuple[float, ...], like: Tensor) -> Shaped[Tensor, "n"]:
    """Return ``values`` with the dtype and device of ``like``. Do not write into the result: it is shared."""
    found = _constant(values, like.dtype, like.device)
    for notes in _notes:
        notes.append(found)
    return found


@contextmanager
def noted() -> Iterator[list[Tensor]]:
    """Collect all constants that are requested within the context, in any thread: the list keeps them alive."""
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
    """Forget all constants, for instance once a device no longer exists."""
    _constant.cache_clear()
