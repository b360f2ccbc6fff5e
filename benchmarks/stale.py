"""Which of the records that the README and the documentation cite are older than the last change of what they measure.

    python benchmarks/stale.py            # the state of each cited record; fails for one that is newly out of date
    python benchmarks/stale.py --accept   # rewrite the list of those that are known to be out of date, for a review
    python benchmarks/stale.py --make     # make those anew, two at a time; go on after an interruption

A record is out of date once a file that it depends on has changed in more than its comments, docstrings and formatting since the
record's commit. ``results/stale.txt`` lists the records that are known to be out of date, each with that commit. A record that is out
of date and not listed fails, as does a line about a record that has been made anew.

``--make`` runs the command that each record names, in this environment and at the commit that is checked out; a record that fails is
named, and the others are made. Single answers of an interrupted run are used again unless what they measure has changed since. The
folders ``BIDNERF_DATA`` and ``BIDNERF_MAPS`` hold the datasets and the maps, see ``answer_maps.py``. Names limit it to some records.
"""

from __future__ import annotations

import argparse
import ast
import json
import re
import shlex
import subprocess
import sys
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from datetime import datetime
from functools import cache
from pathlib import Path
from shutil import rmtree
from typing import Any

ROOT = Path(__file__).parents[1]

IMAGES = tuple(f"bidnerf_core/{package}" for package in ("camera", "depth", "fields", "frames", "geometry"))
HASHGRID = "backends/bidnerf_hashgrid"
LOCALIZATION = (*IMAGES, "bidnerf_core/localization", "bidnerf_core/mapping", HASHGRID)
TRAINING = (*LOCALIZATION, "bidnerf_core/carving", "bidnerf_core/training")
SHARED = tuple(f"bidnerf_core/localization/{part}" for part in ("methods.py", "problem.py", "settings.py", "terms"))
DESCENT = (*IMAGES, *SHARED, "backends/bidnerf_bid", HASHGRID)
MEASURED: Mapping[str, Sequence[str]] = {
    "quick_maps|standard_": TRAINING,
    "fields_by_cell": (*TRAINING, "backends/bidnerf_cells"),
    "tracking": (*LOCALIZATION, "bidnerf_core/maps/tracker.py"),
    "bid_|inerf_|table": DESCENT,
    "faults_": (*LOCALIZATION, "bidnerf/evaluation/faults"),
    "detectors": (*LOCALIZATION, "plugins/bidnerf-xfeat"),
    "splats": (*LOCALIZATION, "plugins/bidnerf-gaussians"),
    "scans": (*LOCALIZATION, "plugins/bidnerf-scan"),
    "service": ("bidnerf/service",),
    "viewer": ("bidnerf/viewer",),
    "photos_without_poses": (*IMAGES, "bidnerf_core/mapping", "bidnerf/structure"),
    "photos_": (*LOCALIZATION, "bidnerf/structure"),
    "gpu": (*TRAINING, "bidnerf_core/devices.py"),
    "": LOCALIZATION,
}
"""The folders on which records depend, by the beginnings of their names; the first that fits counts."""

OF_OTHERS = {"risk"}
"""Records that are made from those of others, when these are there."""


def cited(root: Path) -> list[str]:
    """Return the names of the records that the captions of tables name, in the README and in the documentation."""
    pages = [root / "README.md", *sorted((root / "docs").glob("*.md"))]
    captions = [text for page in pages for text in re.findall(r"^\*Records: (.*?)\.\*$", page.read_text(), re.M | re.S)]
    return sorted({name for caption in captions for name in re.findall(r"`(\w+)`", caption)})


def git(root: Path, *words: str) -> str:
    """Return what git prints; empty if it fails, as for a commit of a branch that was rewritten."""
    return subprocess.run(["git", *words], cwd=root, capture_output=True, text=True, errors="replace").stdout


@cache
def meaning(root: Path, blob: str, is_python: bool) -> str:
    """Return the content of a file in git; of Python, the syntax tree without docstrings, which knows no comments and no formatting."""
    if not blob.strip("0"):
        return "no such file"
    if not is_python:
        return blob
    tree = ast.parse(git(root, "cat-file", "blob", blob))
    for node in ast.walk(tree):
        if isinstance(body := getattr(node, "body", None), list):
            body[:] = [
                line for line in body if not (isinstance(line, ast.Expr) and isinstance(line.value, ast.Constant))
            ]
    return ast.dump(tree)


def changes(root: Path, name: str, commit: str, date: str) -> list[str]:
    """Return the files that a record depends on and that have changed in meaning between a commit and HEAD."""
    paths = next(paths for names, paths in MEASURED.items() if re.match(names, name))
    if not git(root, "merge-base", commit, "HEAD"):  # of a branch that was rewritten
        commit = git(root, "rev-list", "-1", f"--before={date}", "HEAD").strip()
        commit = commit or git(root, "hash-object", "-t", "tree", "/dev/null").strip()
    found = []
    for row in git(root, "diff", "--raw", "--no-abbrev", "--no-renames", commit, "HEAD", "--", *paths).splitlines():
        about, path = row.split("\t")
        _, _, before, after, _ = about.split()
        kind = path.endswith((".py", ".pyi"))
        if not path.endswith(".md") and meaning(root, before, kind) != meaning(root, after, kind):
            found.append(path)
    return found


def make(root: Path, name: str, command: str) -> str:
    """Make a record anew; return a line about how that went."""
    results = root / "benchmarks" / "results"
    begun, head = results / f"{name}.begun", git(root, "rev-parse", "HEAD").strip()
    if not begun.exists() or changes(root, name, *begun.read_text().split()):
        for rows in results.glob(f"{name}.*jsonl"):
            rows.unlink()
        rmtree(root / "benchmarks" / "cache" / name, ignore_errors=True)
        begun.write_text(f"{head} {datetime.now().isoformat()}")
    with (results / f"{name}.log").open("w") as log:
        words = [sys.executable, *shlex.split(command)[1:]]
        status = subprocess.run(words, cwd=root, stdout=log, stderr=subprocess.STDOUT).returncode
    if status:
        return f"{name}: FAILED with status {status}, see {log.name}"
    begun.unlink()
    (results / f"{name}.meta.json").unlink(missing_ok=True)  # beside results from which a run resumes
    return f"{name}: made"


def main(arguments: Sequence[str] | None = None, root: Path = ROOT) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", help="of records (default: all that are cited)")
    parser.add_argument("--accept", action="store_true", help="rewrite the list of known ones")
    parser.add_argument("--make", action="store_true", help="make what is out of date anew")
    given = parser.parse_args(arguments)
    results, faults, stale = root / "benchmarks" / "results", list[str](), dict[str, dict[str, Any]]()
    known = dict(line.split() for line in (results / "stale.txt").read_text().splitlines() if line[:1] not in ("", "#"))
    for name in given.names or cited(root):
        record = json.loads((results / f"{name}.json").read_text())
        commit = record["commit"][:10]
        if newer := changes(root, name, record["commit"], record["date"]):
            stale[name] = record
            print(f"{name}: made at {commit}, since when {len(newer)} files have changed, such as {newer[0]}")
            if known.get(name) != commit:
                faults.append(f"{name} is newly out of date: make it anew, or list it by --accept")
        else:
            print(f"{name}: up to date")
    if not given.names:
        needless = known.keys() - stale.keys()
        faults += [f"{name} is listed, but not out of date or not cited: --accept" for name in sorted(needless)]
    if given.make:
        possible = [name for name, record in stale.items() if not record.get("gpu")]
        faults = []
        for names in (set(possible) - OF_OTHERS, set(possible) & OF_OTHERS):
            with ThreadPoolExecutor(2) as two:
                for line in two.map(
                    lambda name: make(root, name, stale[name]["command"]), sorted(names) if not faults else ()
                ):
                    print(line, flush=True)
                    faults += [line] if "FAILED" in line else []
    elif given.accept:
        head = "# Cited records that are older than the last change of what they measure, with their commits: see ../stale.py\n"
        lines = (f"{name} {record['commit'][:10]}\n" for name, record in stale.items())
        (results / "stale.txt").write_text(head + "".join(lines))
        return 0
    print(*faults, sep="\n", file=sys.stderr, end="\n" if faults else "")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
