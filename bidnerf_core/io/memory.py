"""The memory and the cores that are available to this process."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

import psutil


def available_memory() -> int:
    """Return the available memory of the machine in bytes, or what is left of a container's limit if that is less."""
    available: int = psutil.virtual_memory().available
    with contextlib.suppress(OSError, ValueError):  # no container, or one without a limit
        limit, used = (
            int(Path("/sys/fs/cgroup", name).read_text()) for name in ("memory.max", "memory.current")
        )
        available = min(available, max(0, limit - used))
    return available


def usable_cores() -> int:
    """Return the number of cores that this process may use."""
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return usable or 1
