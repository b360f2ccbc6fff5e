"""The memory still available to this process."""

from __future__ import annotations

import contextlib
import os
import re
from pathlib import Path

MEMINFO = Path("/proc/meminfo")
CGROUP = Path("/sys/fs/cgroup")


def available_memory() -> int | None:
    """Return the available memory in bytes, or half of the machine's total if only that is known; else None."""
    found = [_of_system(), _of_cgroup()]
    known = [size for size in found if size is not None]
    return min(known) if known else None


def _of_system() -> int | None:
    with contextlib.suppress(OSError, ValueError, AttributeError):
        match = re.search(r"MemAvailable:\s+(\d+) kB", MEMINFO.read_text())
        if match is not None:
            return int(match[1]) * 1024
    with contextlib.suppress(OSError, ValueError, AttributeError):
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 2
    return None


def _of_cgroup() -> int | None:
    """Return the memory left in a container's limit."""
    with contextlib.suppress(OSError, ValueError):
        limit, used = ((CGROUP / name).read_text() for name in ("memory.max", "memory.current"))
        return max(0, int(limit) - int(used))
    return None
