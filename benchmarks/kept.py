"""Results that survive an interruption."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any


class Kept:
    """Results by key, in a file of one JSON line each; what a kill left half-written is made again."""

    def __init__(self, path: Path) -> None:
        self.path = path
        lines = path.read_text().splitlines(keepends=True) if path.exists() else []
        whole = [line for line in lines if line.endswith("}\n")]
        self.rows = {found["key"]: found["row"] for found in map(json.loads, whole)}
        if len(whole) < len(lines):
            path.write_text("".join(whole))

    def get(self, key: list[str], make: Callable[[], Any]) -> Any:
        """The row of ``key``, made where it is not there."""
        text = json.dumps(key)
        if text not in self.rows:
            self.rows[text] = make()
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with self.path.open("a") as file:
                file.write(json.dumps({"key": text, "row": self.rows[text]}) + "\n")
        return self.rows[text]
