"""A table of the counts of all hostile cases, by kind: how many were tried, and how many ended as they must.

    python tests/robustness/counts.py [--only KIND ...] [--scale 1] [--json FILE]

It uses the public interface of the installed version, so that another version can be counted by its own interpreter.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterator
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory

import findings
import formats
import fuzz
import stops
from harness import Check, sound_folder

Kind = Callable[[Path, float], Iterator[Check]]
"""A function of an empty folder and of the scale of the search, 1 for a whole one."""


def stopping(kind: str) -> Kind:
    return lambda work, scale: stops.checks(work, [kind], round(25 * scale), round(50 * scale), 60 * scale)


def format_checks(part: Callable[[Path, Path], Iterator[Check]]) -> Kind:
    def checks(work: Path, scale: float) -> Iterator[Check]:
        (work / "sound").mkdir()
        return part(sound_folder(work / "sound", test=6), work)

    return checks


def finding_checks(work: Path, scale: float) -> Iterator[Check]:
    prepared = findings.Work(work)
    for finding in findings.FINDINGS:
        yield from (Check(f"{finding.__name__}: {check.name}", check.wrong) for check in finding(prepared))


KINDS: dict[str, Kind] = {
    "findings": finding_checks,
    "COLMAP counts": format_checks(formats.colmap_counts),
    "tracker states": format_checks(formats.tracker_states),
    "read-only folders": lambda work, scale: stops.checks(work, ["read-only"], 0, 0),
    "signals": stopping("signals"),
    "kills": stopping("kills"),
    "full disks": stopping("disks"),
    "crowds": stopping("crowds"),
    "fuzz": lambda work, scale: fuzz.checks(work, round(2000 * scale), 10 * scale),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=list(KINDS), default=list(KINDS), metavar="KIND")
    parser.add_argument("--scale", type=float, default=1.0, help="of the random searches")
    parser.add_argument("--json", type=Path, help="write the counts and all defects here")
    given = parser.parse_args()
    table, wrong = [], 0
    for kind in given.only:
        began = time.monotonic()
        with TemporaryDirectory() as place:
            Path(place).chmod(0o755)
            found = list(KINDS[kind](Path(place), given.scale))
        bad = {check.name: list(check.wrong) for check in found if check.wrong}
        wrong += len(bad)
        table.append({"kind": kind, "cases": len(found), "sound": len(found) - len(bad), "defects": bad})
        print(f"{kind}: {time.monotonic() - began:.0f} s", file=sys.stderr, flush=True)
    print(f"bidnerf {version('bidnerf')}\n\n| kind | cases | sound | defects |\n| --- | --- | --- | --- |")
    for row in table:
        print(f"| {row['kind']} | {row['cases']} | {row['sound']} | {len(row['defects'])} |")
    if given.json:
        given.json.write_text(json.dumps(table, indent=1) + "\n")
    sys.exit(wrong > 0)


if __name__ == "__main__":
    main()
