"""A running service asked by Schemathesis, which knows nothing but its OpenAPI description."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections import Counter
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

HOOKS = Path(__file__).with_name("_openapi_hooks.py")
CONFIG = """
[checks]
positive_data_acceptance.expected-statuses = ["2xx", "400", "404", "422", "429"]
"""
"""What OpenAPI cannot express makes a valid request a bad one: bytes that are no image (422), a field in the query and in the form
(400). So this check says no more than that such requests are not answered with another status.
"""


def is_installed() -> bool:
    """Return whether Schemathesis is installed."""
    return find_spec("schemathesis") is not None


def run_schemathesis(
    address: str,
    scene: str,
    photos: Sequence[bytes],
    examples: int,
    seed: int = 0,
    token: str | None = None,
    without: str = "",
) -> dict[str, Any]:
    """Send photos of the map ``scene`` in every way that is described, and up to ``examples`` drawn requests to each operation, beside those that the description itself suggests.

    Paths that match ``without`` are left out. There is one client: Hypothesis changes the recursion limit, which Python 3.11's parser does not survive in another thread.
    Returns the number of requests, their statuses, the headers that came with each, and the failures of each check.
    """
    with TemporaryDirectory() as place:
        folder = Path(place)
        (folder / "photos").mkdir()
        for number, photo in enumerate(photos):
            (folder / "photos" / f"{number:03}").write_bytes(photo)
        (folder / "schemathesis.toml").write_text(CONFIG)
        report, counts = folder / "report.json", folder / "counts.json"
        words = [
            "--config-file",
            folder / "schemathesis.toml",
            "--no-color",
            "run",
            f"{address}/openapi.json",
            "--checks",
            "all",
            "--mode",
            "all",
            "--max-examples",
            examples,
            "--seed",
            seed,
            "--workers",
            1,
            "--continue-on-failure",
            "--request-timeout",
            90,
            "--suppress-health-check",
            "all",
            "--generation-database",
            "none",
            "--report",
            "json",
            "--report-json-path",
            report,
            *(["-H", f"Authorization: Bearer {token}"] if token else []),
            *(["--exclude-path-regex", without] if without else []),
        ]
        done = subprocess.run(
            [sys.executable, "-c", "from schemathesis.cli import schemathesis; schemathesis()", *map(str, words)],
            cwd=folder,
            capture_output=True,
            text=True,
            check=False,
            env=os.environ
            | {"SCHEMATHESIS_HOOKS": str(HOOKS), "MAP": scene, "PHOTOS": str(folder / "photos"), "COUNTS": str(counts)},
        )
        if not report.exists():
            raise RuntimeError(done.stdout + done.stderr)
        return _summary(json.loads(report.read_text()), json.loads(counts.read_text()), done.stdout)


def _summary(report: dict[str, Any], counts: dict[str, Any], output: str) -> dict[str, Any]:
    every = Counter[str]()
    for key, count in counts["statuses"].items():
        every[key.rpartition(" ")[2]] += count
    answered = {key.rpartition(" ")[0]: n for key, n in counts["statuses"].items() if key.endswith(" 200")}
    return {
        "schemathesis": report["schemathesis_version"],
        "operations": report["operations"]["tested"],
        "requests": sum(every.values()),
        "statuses": dict(sorted(every.items())),
        "answered_with_200": dict(sorted(answered.items())),
        "failures": {failure["type"]: failure["count"] for failure in report["failures"]},
        "errors": {error["title"]: error["count"] for error in report["errors"]},
        "slowest_seconds": counts["slowest_seconds"],
        "headers": counts["headers"],
        "output": output,
    }
