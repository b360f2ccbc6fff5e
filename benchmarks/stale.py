"""Which of the records that the README and the documentation cite are older than the last change of what they measure.

    python benchmarks/stale.py            # the state of each cited record; fails for one that is newly out of date
    python benchmarks/stale.py --accept   # rewrite the list of those that are known to be out of date, for a review

``results/stale.txt`` lists the records that are known to be out of date, each with the commit at which it was made. A record that is
out of date and not listed fails, as does a line about a record that has been made anew.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]

CORE = ("camera", "depth", "fields", "frames", "geometry", "localization", "mapping")
LOCALIZATION = tuple(f"bidnerf_core/{package}" for package in CORE)
TRAINING = (*LOCALIZATION, "backends/bidnerf_hashgrid", "bidnerf_core/carving", "bidnerf_core/training")
MEASURED: Mapping[str, Sequence[str]] = {
    "map_lego_vanilla|table1_lego_vanilla": (*TRAINING, "backends/bidnerf_vanilla"),
    "map_|quick_maps|living_maps": TRAINING,
    "bid_|inerf_|table": (*LOCALIZATION, "backends/bidnerf_bid"),
    "faults_": (*LOCALIZATION, "bidnerf/evaluation/faults"),
    "detectors": (*LOCALIZATION, "plugins/bidnerf-xfeat"),
    "splats": (*LOCALIZATION, "plugins/bidnerf-gaussians"),
    "scans": (*LOCALIZATION, "plugins/bidnerf-scan"),
    "service": ("bidnerf/service",),
    "viewer": ("bidnerf/viewer",),
    "photos_": (*LOCALIZATION, "bidnerf/structure"),
    "gpu": (*TRAINING, "bidnerf_core/devices.py"),
    "": LOCALIZATION,
}
"""The folders on which records depend, by the beginnings of their names; the first that fits counts."""


def cited(root: Path) -> list[str]:
    """Return the names of the records that the captions of tables name, in the README and in the documentation."""
    pages = [root / "README.md", *sorted((root / "docs").glob("*.md"))]
    captions = [text for page in pages for text in re.findall(r"^\*Records: (.*?)\.\*$", page.read_text(), re.M | re.S)]
    return sorted({name for caption in captions for name in re.findall(r"`(\w+)`", caption)})


def changes(root: Path, name: str, record: Mapping[str, Any]) -> list[str]:
    """Return the commits that changed what a record measures after it was made, the latest one first."""

    def git(*words: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(["git", *words], cwd=root, capture_output=True, text=True)

    paths = next(paths for names, paths in MEASURED.items() if re.match(names, name))
    is_known = git("merge-base", "--is-ancestor", record["commit"], "HEAD").returncode == 0
    since = (
        [f"{record['commit']}..HEAD"] if is_known else [f"--since={record['date']}"]
    )  # of a branch that was rewritten
    log = git("log", "--format=%h %cs %s", *since, "--", *paths, ":!*.md")
    log.check_returncode()
    return log.stdout.splitlines()


def main(arguments: Sequence[str] | None = None, root: Path = ROOT) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--accept", action="store_true", help="rewrite the list of known ones")
    accept = parser.parse_args(arguments).accept
    results, faults, stale = root / "benchmarks" / "results", list[str](), dict[str, str]()
    known = dict(line.split() for line in (results / "stale.txt").read_text().splitlines() if line[:1] not in ("", "#"))
    for name in cited(root):
        record = json.loads((results / f"{name}.json").read_text())
        commit = record["commit"][:10]
        if newer := changes(root, name, record):
            stale[name] = commit
            print(f"{name}: made at {commit}, {len(newer)} changes since, the last one {newer[0]}")
            if known.get(name) != commit:
                faults.append(f"{name} is newly out of date: make it anew, or list it by --accept")
        else:
            print(f"{name}: up to date")
    faults += [f"{name} is listed, but not out of date or not cited: --accept" for name in known.keys() - stale.keys()]
    if accept:
        head = "# Cited records that are older than the last change of what they measure, with their commits: see ../stale.py\n"
        (results / "stale.txt").write_text(head + "".join(f"{name} {commit}\n" for name, commit in stale.items()))
        return 0
    print(*faults, sep="\n", file=sys.stderr, end="\n" if faults else "")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
