"""Constants as tensors: each is made once on each device, since making one copies it there from the host."""

from __future__ import annotations

from functools import lru_cache

import torch
from jaxtyping import Shaped
from torch import Tensor


def constant(values: tuple[float, ...], like: Tensor) -> Shaped[Tensor, "n"]:
    """Return ``values`` in the type and on the device of ``like``. Do not write into the result: it is shared."""
    return _constant(values, like.dtype, like.device)


@lru_cache(maxsize=256)
def _constant(values: tuple[float, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    with torch.inference_mode(False):
        return torch.tensor(values, dtype=dtype).to(device)


def forget() -> None:
    """Forget all constants, as after a device has gone."""
    _constant.cache_clear()
