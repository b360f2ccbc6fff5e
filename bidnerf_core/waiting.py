"""Control over whether code may let the host wait for the device.

On a GPU, each number that the host reads from a tensor, and each size that depends on values, makes the host wait until the
device has done all its work. Skipping needless computation is worth that wait in training and where whole images are
rendered, but not in the steps of a localization, which are short. There, code computes more than it needs, in known shapes.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

import torch

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
    """Return whether code may read from tensors on ``device``; always True on the CPU, where there is nothing to wait for."""
    return device.type == "cpu" or _allowed.get()
