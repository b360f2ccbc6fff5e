"""Writes a benchmark's results together with what is needed to repeat them."""

from __future__ import annotations

import json
import os
import platform
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import torch

from bidnerf_core.evaluation.provenance import cpu_model, git, script_command

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results"


def write_record(name: str, results: dict[str, Any], seed: int, folder: Path = RESULTS) -> Path:
    """Write ``<folder>/<name>.json`` with the commit, the hardware, the versions, the command and the date."""
    record = {
        "benchmark": name,
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "commit": git("rev-parse", "--verify", "HEAD") or None,
        "dirty": bool(git("status", "--porcelain", "--", ".", ":!benchmarks/results")),
        "command": script_command(),
        "seed": seed,
        "cpu": cpu_model(),
        "cores": os.cpu_count(),
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
        "threads": torch.get_num_threads(),
        "python": platform.python_version(),
        "torch": torch.__version__,
        "numpy": np.__version__,
        "results": results,
    }
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}.json"
    path.write_text(json.dumps(record, indent=2) + "\n")
    return path
