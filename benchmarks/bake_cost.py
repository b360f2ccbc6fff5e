"""What it costs to bake the surface of a map: time, memory, and size on disk.

    python benchmarks/bake_cost.py --map MAP [MAP ...] [--data DATA] [--name bake_cost]

Each map is copied, loses the surface that it may have, and is baked by ``bidnerf bake`` in a process of its own, one
thread. ``--data``: as there; measured depth is taken where there is some.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from record import write_record

from bidnerf_core.storage import load_info, load_map

MAIN = "import sys; from bidnerf_core.cli import main; sys.exit(main())"


def baked(source: Path, data: Path | None, folder: Path) -> dict[str, Any]:
    copy = Path(shutil.copytree(source, folder / source.name))
    old = load_info(copy).surface
    if old is not None:
        (copy / str(old)).unlink(missing_ok=True)
    before, began = size(copy), time.perf_counter()
    words = [sys.executable, "-c", MAIN, "bake", str(copy), *(["--data", str(data)] if data else [])]
    child = os.posix_spawn(sys.executable, words, os.environ | {"OMP_NUM_THREADS": "1"})
    _, status, used = os.wait4(child, 0)
    if status:
        raise SystemExit(f"{source}: 'bidnerf bake' failed")
    surface = load_map(copy).surface
    assert surface is not None
    return {
        "seconds, import of torch included": time.perf_counter() - began,
        "cpu_seconds": used.ru_utime + used.ru_stime,
        "peak_resident_MiB": used.ru_maxrss / 2**10,
        "added_on_disk_MiB": (size(copy) - before) / 2**20,
        "surfels": len(surface.surfels),
        "cell_metres": surface.cell,
        "cells": list(surface.nearest.shape),
        "keyframes": len(surface.keyframes),
    }


def size(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--map", type=Path, nargs="+", required=True)
    parser.add_argument("--data", type=Path)
    parser.add_argument("--name", default="bake_cost")
    given = parser.parse_args()
    with TemporaryDirectory() as folder:
        results = {source.name: baked(source, given.data, Path(folder)) for source in given.map}
    print(write_record(given.name, {"maps": results}, 0))
    print(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
