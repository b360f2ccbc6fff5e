"""The provenance needed to reproduce results (command, code and machine), and records that include it."""

from __future__ import annotations

import json
import os
import platform
import re
import shlex
import subprocess
import sys
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import psutil
import torch

import bidnerf_core
from bidnerf_core.errors import InputError
from bidnerf_core.io import from_plain, read_record, to_plain, write_file

VERSIONS = ("bidnerf", "torch", "numpy", "scipy", "kornia")
SOURCES = ("bidnerf_core", "backends", "plugins", "benchmarks", ":!benchmarks/results")
"""Folders in which uncommitted changes make a run irreproducible from its commit."""
RUNS = ".meta.json"
"""The ending of the file that lists the runs behind a results file, next to it."""
LINE = 120
"""Columns per line of a record: nested values that fit are written on one line."""


@dataclass(frozen=True)
class Provenance:
    """When, how and where a run took place."""

    date: str  # UTC, when it began
    command: str
    commit: str | None  # of the checkout that the code was run from
    dirty: bool  # whether files of that checkout were modified
    cpu: str
    cores: int | None
    gpu: str | None
    memory_bytes: int | None
    system: str
    python: str
    versions: dict[str, str]
    workers: str  # a description of the workers that ran the trials


def provenance(command: str, workers: str) -> Provenance:
    """Return the provenance of a run that begins now; ``workers`` describes what runs it."""
    return Provenance(
        date=datetime.now(UTC).isoformat(timespec="seconds"),
        command=command,
        commit=_git("rev-parse", "--verify", "HEAD") or None,
        dirty=bool(_git("status", "--porcelain", "--untracked-files=no", "--", *SOURCES)),
        cpu=_cpu_model(),
        cores=os.cpu_count(),
        gpu=torch.cuda.get_device_name() if torch.cuda.is_available() else None,
        memory_bytes=psutil.virtual_memory().total,
        system=f"{platform.system()} {platform.machine()}",
        python=platform.python_version(),
        versions={name: version(name) for name in VERSIONS} | {"torch": str(torch.__version__)},
        workers=workers,
    )


def note_run(results: Path, run: Provenance) -> None:
    """Add a run to the list next to a results file, which may take several runs to complete."""
    runs = [*read_runs(results), run]
    write_file(results.with_suffix(RUNS), (json.dumps({"runs": to_plain(runs)}, indent=1) + "\n").encode())


def read_runs(results: Path) -> list[Provenance]:
    """Return the runs behind a results file, in order; empty if there is no list next to it."""
    path = results.with_suffix(RUNS)
    if not path.is_file():
        return []
    expected = "the list that 'bidnerf evaluate' writes next to its results"
    runs = read_record(path, expected).items("runs")
    if runs is None:
        raise InputError("not a list of runs", where=path, expected=expected)
    return [from_plain(Provenance, run, str(path)) for run in runs]


def _git(*arguments: str) -> str:
    """Return the output of a git command in this package's checkout; empty if there is no checkout or no git."""
    root = Path(bidnerf_core.__file__).resolve().parents[1]
    if not (root / ".git").exists():  # installed, perhaps inside another project
        return ""
    try:
        done = subprocess.run(["git", *arguments], cwd=root, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return ""
    return done.stdout.strip()


def _cpu_model() -> str:
    """Return the name of the processor."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    names = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(names, platform.processor())


def script_command() -> str:
    """Return the command of the running script; paths are relative to the checkout, or only names outside it."""
    root = Path(bidnerf_core.__file__).resolve().parents[1]

    def shortened(part: str) -> str:
        path = Path(part)
        if not path.is_absolute():
            return part
        return str(path.relative_to(root)) if path.is_relative_to(root) else path.name

    # Words such as ``--out=PATH`` and ``MAP:DATA`` hold paths, too.
    words = ("".join(map(shortened, re.split(r"([=:])", word))) for word in sys.argv)
    return shlex.join(words if Path(sys.argv[0]).name == "bidnerf" else ["python", *words])


def write_record(path: Path, results: dict[str, Any], seed: int) -> Path:
    """Write the results of a benchmark script with its provenance to ``path``, a JSON file, and return the
    path.

    Raises ``ValueError`` if ``results`` contain values that strict JSON cannot represent.
    """
    threads = torch.get_num_threads()
    run = provenance(script_command(), f"one process of {threads} thread{'s' if threads > 1 else ''}")
    record = {"benchmark": path.stem, **to_plain(run), "seed": seed, "results": results}
    content = _in_lines(record) + "\n"
    path.parent.mkdir(parents=True, exist_ok=True)
    write_file(path, content.encode())
    return path


def _in_lines(value: Any, indent: str = "") -> str:
    """Return a value as JSON, with each object or list on one line if it fits into ``LINE`` columns."""
    line = json.dumps(value, allow_nan=False)
    if len(indent) + len(line) <= LINE or not value or not isinstance(value, (dict, list, tuple)):
        return line
    deeper = indent + " "
    if isinstance(value, dict):
        parts = [f"{json.dumps(key)}: {_in_lines(part, deeper)}" for key, part in value.items()]
    else:
        parts = [_in_lines(part, deeper) for part in value]
    first, last = "{}" if isinstance(value, dict) else "[]"
    return f"{first}\n{deeper}" + f",\n{deeper}".join(parts) + f"\n{indent}{last}"
