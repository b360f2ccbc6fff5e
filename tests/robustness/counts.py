"""A table of the counts of all hostile cases, by kind: how many were tried, and how many ended as they must.

    python tests/robustness/counts.py [--only [KIND ...]] [--scale 1] [--record]

``--record`` writes the table to benchmarks/results/robustness.json. It goes on after an interruption: a kind that has been tried at
this commit is not tried again, and of kinds that are not asked for, the latest counts are written, with their commits.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Callable, Iterable
from contextlib import nullcontext
from functools import partial
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

sys.path.append(str(Path(__file__).parents[1] / "support"))
sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))

from _lab import RESULTS, RowStore, record

import attacks
import fuzz
import intruders
import stops
from bidnerf.evaluation import provenance
from harness import Check

KINDS: dict[str, Callable[[Path, float], Iterable[Check]]] = {
    # Functions of an empty folder and of the scale of the random searches, 1 for whole ones.
    "hostile files in datasets": lambda work, scale: attacks.readers(work, round(820 * scale)),
    "files that expand": lambda work, scale: attacks.files(work),
    "hostile requests": lambda work, scale: attacks.routes(work),
    "misbehaving clients": lambda work, scale: intruders.clients(intruders.guarded(work)),
    "current folders": lambda work, scale: intruders.current_folder(intruders.guarded(work)),
    "strangers' maps": lambda work, scale: intruders.maps(intruders.guarded(work)),
    "strangers' results": lambda work, scale: intruders.results(intruders.guarded(work)),
    "strangers' cameras": lambda work, scale: intruders.cameras(intruders.guarded(work)),
    "paths": lambda work, scale: intruders.paths(intruders.guarded(work)),
    "large inputs": lambda work, scale: fuzz.large_inputs(work),
    "COLMAP counts": lambda work, scale: fuzz.checks(work, round(150 * scale), only=fuzz.MODEL),
    "tracker states": lambda work, scale: fuzz.checks(work, round(600 * scale), only=fuzz.STATE),
    "unwritable": lambda work, scale: stops.unwritable(work),
    "signals": lambda work, scale: stops.checks(work, "signals", round(50 * scale)),
    "kills": lambda work, scale: stops.checks(work, "kills", round(25 * scale)),
    "full disks": lambda work, scale: stops.checks(work, "disks", 0),
    "crowds": lambda work, scale: stops.checks(work, "crowds", 0, 60 * scale),
    "fuzz": lambda work, scale: fuzz.checks(work, round(2000 * scale), 10 * scale),
}


def counted(kind: str, scale: float) -> dict[str, Any]:
    """Try all cases of a kind; return how many there were, how many ended as they must, the times (seconds), and the defects."""
    began, times = time.monotonic(), os.times()
    with TemporaryDirectory() as place:
        Path(place).chmod(0o755)
        found = list(KINDS[kind](Path(place), scale))
    # A record is read elsewhere, so its paths are those of the repository.
    root = f"{Path(__file__).resolve().parents[2]}/"
    defects = {check.name: [wrong.replace(root, "") for wrong in check.wrong] for check in found if check.wrong}
    after = os.times()
    return {
        "cases": len(found),
        "sound": len(found) - len(defects),
        "seconds": time.monotonic() - began,
        "cpu_seconds": sum(after[:4]) - sum(times[:4]),
        "defects": defects,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="*", choices=list(KINDS), default=list(KINDS), metavar="KIND")
    parser.add_argument("--scale", type=float, default=1.0, help="of the random searches")
    parser.add_argument("--record", action="store_true", help="write benchmarks/results/robustness.json")
    given = parser.parse_args()
    table, commit = dict[str, dict[str, Any]](), provenance("", "").commit
    with RowStore(RESULTS / "robustness.rows.jsonl") if given.record else nullcontext() as rows:
        for kind in given.only:
            count = partial(counted, kind, given.scale)
            table[kind] = count() if rows is None else rows.get([kind, given.scale, commit], count)
            print(f"{kind}: {table[kind]['seconds']:.0f} s", file=sys.stderr, flush=True)
    print(f"bidnerf {version('bidnerf')}\n\n| kind | cases | sound | defects |\n| --- | --- | --- | --- |")
    for kind, row in table.items():
        print(f"| {kind} | {row['cases']} | {row['sound']} | {len(row['defects'])} |")
        for name, wrong in row["defects"].items():
            print(f"{name}: {'; '.join(wrong)}", file=sys.stderr)
    if rows is not None:
        latest = {}
        for key, row in rows.rows.items():
            kind, scale, at = json.loads(key)
            latest[kind] = {"commit": at, "scale": scale} | row
        record("robustness", {kind: latest[kind] for kind in KINDS if kind in latest})
    sys.exit(any(row["defects"] for row in table.values()))


if __name__ == "__main__":
    main()
