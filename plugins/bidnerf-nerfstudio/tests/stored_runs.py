"""Where the runs of nerfstudio are that ``make_runs.py`` made, and how a test asks for a copy of one."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

RUNS = Path(__file__).parent / "runs"

RunOf = Callable[[str], Path]
