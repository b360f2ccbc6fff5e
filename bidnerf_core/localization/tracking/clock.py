"""The time between frames."""

from __future__ import annotations

import math
from dataclasses import dataclass

from bidnerf_core.errors import InputError


@dataclass(frozen=True)
class Clock:
    """The time of the last frame. Frames without a time stamp come at the interval of the last two that had one."""

    now: float | None  # seconds, from any origin
    interval: float  # seconds
    stamped: bool = True  # whether the last frame had a time stamp

    def step(self, time: float | None) -> tuple[Clock, float]:
        """Return the clock at the next frame, and the seconds since the last one: negative if it came out of order.

        Raises ``InputError`` for a time that is not finite.
        """
        if time is None:
            now = None if self.now is None else self.now + self.interval
            return Clock(now, self.interval, stamped=False), self.interval
        if not math.isfinite(time):
            raise InputError(f"time of the frame is {time}, expected seconds or None")
        if self.now is None:
            return Clock(time, self.interval), self.interval
        seconds = time - self.now
        return Clock(time, seconds if seconds > 0 else self.interval), seconds
