"""A stopwatch that adds up the seconds of each stage."""

from __future__ import annotations

import time


class Stopwatch:
    """Adds the seconds since the last lap to a stage."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, stage: str) -> None:
        """End a lap, which belonged to ``stage``."""
        now = time.perf_counter()
        self.seconds[stage] = self.seconds.get(stage, 0.0) + now - self._last
        self._last = now
