"""Writes a benchmark's results together with what is needed to repeat them."""

from __future__ import annotations

import json
import os
import platform
import shlex
import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import torch

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results"


def write_record(name: str, results: dict[str, Any], seed: int) -> Path:
    """Write ``results/<name>.json`` with the commit, the hardware, the versions, the command and the date."""
    record = {
        "benchmark": name,
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "commit": _git("rev-parse", "--verify", "HEAD") or None,
        "dirty": bool(_git("status", "--porcelain", "--", ".", ":!benchmarks/results")),
        "command": _command(),
        "seed": seed,
        "cpu": _cpu_model(),
        "cores": os.cpu_count(),
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
        "threads": torch.get_num_threads(),
        "python": platform.python_version(),
        "torch": torch.__version__,
        "numpy": np.__version__,
        "results": results,
    }
    RESULTS.mkdir(parents=True, exist_ok=True)
    path = RESULTS / f"{name}.json"
    path.write_text(json.dumps(record, indent=2) + "\n")
    return path


def _git(*arguments: str) -> str:
    """Output of a git command in the repository, or nothing where there is no git or no commit yet."""
    try:
        done = subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return ""
    return done.stdout.strip()


def _command() -> str:
    """The command line with paths relative to the repository; of a path outside of it, only the name is kept."""
    return shlex.join(["python", *(_without_local_path(argument) for argument in sys.argv)])


def _without_local_path(argument: str) -> str:
    option, equals, value = argument.rpartition("=")
    path = Path(value)
    if path.is_relative_to(ROOT):
        value = str(path.relative_to(ROOT))
    elif path.is_absolute():
        value = path.name
    return option + equals + value


def _cpu_model() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    names = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(names, platform.processor())
