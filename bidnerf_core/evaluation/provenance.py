"""The provenance needed to reproduce results: command, code and machine."""

from __future__ import annotations

import filecmp
import json
import os
import platform
import re
import shlex
import subprocess
import sys
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import distribution, version
from pathlib import Path
from urllib.parse import urlsplit
from urllib.request import url2pathname

import psutil
import torch

import bidnerf_core
from bidnerf_core.errors import InputError
from bidnerf_core.io import from_plain, read_record, to_plain, write_file

RUNS = ".meta.json"
"""The ending of the file that lists the runs behind a results file, next to it."""


@dataclass(frozen=True)
class Provenance:
    """When, how and where a run took place."""

    date: str  # UTC, when it began
    command: str
    # of the checkout that the code was run from, or was installed from without changes since
    commit: str | None
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
    # Uncommitted changes in these folders make a run irreproducible from its commit.
    sources = ("bidnerf_core", "backends", "plugins", "benchmarks", ":!benchmarks/results")
    return Provenance(
        date=datetime.now(UTC).isoformat(timespec="seconds"),
        command=command,
        commit=_git("rev-parse", "--verify", "HEAD") or None,
        dirty=bool(_git("status", "--porcelain", "--untracked-files=no", "--", *sources)),
        cpu=_cpu_model(),
        cores=os.cpu_count(),
        gpu=torch.cuda.get_device_name() if torch.cuda.is_available() else None,
        memory_bytes=psutil.virtual_memory().total,
        system=f"{platform.system()} {platform.machine()}",
        python=platform.python_version(),
        versions={name: version(name) for name in ("bidnerf", "torch", "numpy", "scipy", "kornia")}
        | {"torch": str(torch.__version__)},
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
    package = Path(bidnerf_core.__file__).resolve().parent
    root = package.parent
    # An installed package may lie inside another project; PEP 610 names the folder from which it was installed.
    if not (root / ".git").exists():
        stated = json.loads(distribution("bidnerf").read_text("direct_url.json") or "{}").get("url", "")
        root = Path(url2pathname(urlsplit(stated).path))
        code = [str(file.relative_to(package)) for file in package.rglob("*.py")]
        _, *others = filecmp.cmpfiles(package, root / "bidnerf_core", code)
        if any(others) or not (root / ".git").exists():
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
    words = ["".join(map(shortened, re.split(r"([=:])", word))) for word in sys.argv]
    is_ours = Path(words[0]).stem == "bidnerf"  # wherever it is installed
    return shlex.join(["bidnerf", *words[1:]] if is_ours else ["python", *words])
