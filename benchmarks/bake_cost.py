"""The cost of baking the surface of a map: time, memory, and size on disk.

    python benchmarks/bake_cost.py --map MAP [MAP ...] [--data DATA] [--name bake_cost]

Each map is copied without its surface and baked by ``bidnerf bake`` in a process of its own, on one thread. ``--data`` is
passed on to that command, which uses the measured depth where there is any.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from bidnerf_core.evaluation.provenance import write_record
from bidnerf_core.maps.description import load_info
from bidnerf_core.maps.map import load_map

RESULTS = Path(__file__).parent / "results"
# The child measures itself: the child's peak as reported to the parent includes the parent's own.
MAIN = """
import json, sys, time
from bidnerf_core.cli import main
from bidnerf_core.evaluation.trials import peak_memory_bytes

status = main(sys.argv[1:])
print(json.dumps([time.process_time(), peak_memory_bytes()]))
sys.exit(status)
"""


def baked(source: Path, data: Path | None, folder: Path) -> dict[str, Any]:
    copy = Path(shutil.copytree(source, folder / source.name))
    old = load_info(copy).surface
    if old is not None:
        (copy / str(old)).unlink(missing_ok=True)
    before, began = size(copy), time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-c", MAIN, "bake", str(copy), *(["--data", str(data)] if data else [])],
        env=os.environ | {"OMP_NUM_THREADS": "1"}, stdout=subprocess.PIPE, check=True, text=True,
    )  # fmt: skip
    cpu_seconds, peak = json.loads(done.stdout.splitlines()[-1])
    surface = load_map(copy).surface
    assert surface is not None
    return {
        "seconds, import of torch included": time.perf_counter() - began,
        "cpu_seconds": cpu_seconds,
        "peak_resident_MiB": peak / 2**20,
        "added_on_disk_MiB": (size(copy) - before) / 2**20,
        "surfels": len(surface.surfels),
        "cell_metres": surface.cell,
        "cells": list(surface.grid.shape),
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
    if len({source.name for source in given.map}) < len(given.map):
        raise SystemExit("--map: two folders have one name, expected different ones")
    with TemporaryDirectory() as folder:
        results = {source.name: baked(source, given.data, Path(folder)) for source in given.map}
    print(write_record(RESULTS / f"{given.name}.json", {"maps": results}, 0))
    print(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
