"""A table of the counts of all hostile cases, by kind: how many were tried, and how many ended as they must.

python tests/robustness/counts.py [--only KIND ...] [--scale 1] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterable
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory

sys.path.append(str(Path(__file__).parents[1] / "support"))

import attacks
import fuzz
import intruders
import stops
from harness import Check

KINDS: dict[str, Callable[[Path, float], Iterable[Check]]] = {
    # Functions of an empty folder and of the scale of the random searches, 1 for whole ones.
    "attacks": lambda work, scale: attacks.checks(work, round(820 * scale)),
    "intruders": lambda work, scale: intruders.checks(work),
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=list(KINDS), default=list(KINDS), metavar="KIND")
    parser.add_argument("--scale", type=float, default=1.0, help="of the random searches")
    parser.add_argument("--json", type=Path, help="write the counts and all defects here")
    given = parser.parse_args()
    table = []
    for kind in given.only:
        began = time.monotonic()
        with TemporaryDirectory() as place:
            Path(place).chmod(0o755)
            found = list(KINDS[kind](Path(place), given.scale))
        bad = {check.name: list(check.wrong) for check in found if check.wrong}
        table.append({"kind": kind, "cases": len(found), "sound": len(found) - len(bad), "defects": bad})
        print(f"{kind}: {time.monotonic() - began:.0f} s", file=sys.stderr, flush=True)
    print(f"bidnerf {version('bidnerf')}\n\n| kind | cases | sound | defects |\n| --- | --- | --- | --- |")
    for row in table:
        print(f"| {row['kind']} | {row['cases']} | {row['sound']} | {len(row['defects'])} |")
    if given.json:
        given.json.write_text(json.dumps(table, indent=1) + "\n")
    sys.exit(any(row["defects"] for row in table))


if __name__ == "__main__":
    main()
