"""Threads of torch's own operators on a CPU."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from threading import Lock
from typing import TypeVar

import torch

_setting = Lock()
T = TypeVar("T")


@contextmanager
def one_thread() -> Iterator[int]:
    """Within the block, torch's operators that this Python thread calls use one thread; the usual number is yielded.

    Sums are then the same on any machine. Other Python threads are not affected, and may be in such blocks too.
    """
    usual = torch.get_num_threads()
    set_threads_here(1)
    try:
        yield usual
    finally:
        set_threads_here(usual)


def set_threads_here(count: int) -> None:
    """Set how many threads torch's operators use where this Python thread calls them, and nowhere else.

    ``torch.set_num_threads`` also sets the number for Python threads that start later, which is therefore restored.
    """
    with _setting:
        torch.get_num_threads()  # on first use, a thread takes the default, which would replace what is set before
        default = _in_new_thread(torch.get_num_threads)
        torch.set_num_threads(count)
        _in_new_thread(lambda: torch.set_num_threads(default))


def _in_new_thread(function: Callable[[], T]) -> T:
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(function).result()
